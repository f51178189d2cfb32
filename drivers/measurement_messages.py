"""Measurements to ROS 2 messages and back: the messages of recordings and of `raw/<device>`.

Writing keeps everything a measurement says except `HallFrame.sensor_period_ns`, which has no place in a
WhiskerArray and travels beside it (recordings: metadata). Reading counts what it cannot use and never lets a
number through that is not finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from drivers import plain_messages, whisker_array
from drivers.counters import Counters
from drivers.measurement import (
    SCREW_NAMES,
    FloatArray,
    HallFrame,
    ImuSample,
    Measurement,
    OdometrySample,
    ScrewAngles,
    ScrewSpeeds,
)
from drivers.readings import RADIANS_PER_SECOND_PER_RPM
from drivers.ros_messages import Message, MessageError, deserialize, header, new, serialize, time_to_ns

WHISKER_ARRAY = whisker_array.TYPENAME
IMU = plain_messages.IMU
JOINT_STATE = plain_messages.JOINT_STATE
MOTOR_FEEDBACK = "robominer_msgs/msg/MotorModuleFeedback"
TWIST_STAMPED = plain_messages.TWIST_STAMPED
ODOMETRY = "nav_msgs/msg/Odometry"

#: sensor_msgs/Imu: a covariance whose first element is -1 says that the estimate is absent.
ABSENT = -1.0
QUATERNION_TOLERANCE = 0.05
_SCREWS = frozenset(SCREW_NAMES)


class NotFiniteError(MessageError):
    """A message with a number that is not finite where one is needed."""


def encode(measurement: Measurement, frame_id: str = "") -> list[tuple[str, str, bytes]]:
    """The messages of a measurement, as (default topic, message type, CDR bytes).

    One message, but for ScrewSpeeds: one MotorModuleFeedback for each screw that it says something about.
    """
    match measurement:
        case HallFrame():
            return [("whiskers", WHISKER_ARRAY, whisker_array.encode_frame(measurement, frame_id))]
        case ImuSample():
            return [("imu", IMU, _encode_imu(measurement, frame_id))]
        case ScrewAngles():
            return [("screws", JOINT_STATE, _encode_angles(measurement, frame_id))]
        case ScrewSpeeds():
            return _encode_speeds(measurement)
        case OdometrySample():
            return [("odometry/twist", TWIST_STAMPED, _encode_odometry(measurement, frame_id))]


def decode(
    data: bytes,
    typename: str,
    counters: Counters,
    *,
    screw: str | None = None,
    sensor_period_ns: int = 0,
) -> Measurement | None:
    """The measurement in a message, or None where it cannot be used.

    Args:
        data: CDR bytes.
        typename: one of the types of this module; nav_msgs/Odometry gives its twist.
        counters: `messages` taken; dropped: `bad_message`, `not_finite`, `unknown_type`. A whisker whose field is
            not finite is counted as `not_finite` and made invalid, the rest of its frame stays.
        screw: name of the screw that the topic stands for, for motor modules that do not name it themselves.
        sensor_period_ns: goes into HallFrame.
    """
    reader = _READERS.get(typename)
    if reader is None:
        counters["unknown_type"] += 1
        return None
    try:
        measurement = reader(data, _Context(counters, screw, sensor_period_ns))
    except NotFiniteError:
        counters["not_finite"] += 1
        return None
    except MessageError:
        counters["bad_message"] += 1
        return None
    counters["messages"] += 1
    return measurement


class _Context(NamedTuple):
    counters: Counters
    screw: str | None
    sensor_period_ns: int


def _finite(values: Sequence[float], what: str) -> FloatArray:
    # One by one: numpy takes longer to begin than this takes for a few numbers.
    if not all(map(math.isfinite, values)):
        raise NotFiniteError(f"{what} is not finite")
    return np.array(values, dtype=np.float64)


def _new_vector(values: FloatArray) -> Message:
    return new("geometry_msgs/msg/Vector3", x=float(values[0]), y=float(values[1]), z=float(values[2]))


def _decode_hall(data: bytes, context: _Context) -> HallFrame:
    return whisker_array.decode_frame(data, context.counters, context.sensor_period_ns)


def _covariance(known: bool) -> FloatArray:
    covariance = np.zeros(9)
    covariance[0] = 0.0 if known else ABSENT
    return covariance


def _encode_imu(sample: ImuSample, frame_id: str) -> bytes:
    gyro, acceleration, xyzw = sample.gyro, sample.acceleration, sample.orientation_xyzw
    x, y, z, w = (0.0, 0.0, 0.0, 1.0) if xyzw is None else (float(value) for value in xyzw)
    message = new(
        IMU,
        header=header(sample.stamp_ns, frame_id),
        orientation=new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        orientation_covariance=_covariance(xyzw is not None),
        angular_velocity=_new_vector(np.zeros(3) if gyro is None else gyro),
        angular_velocity_covariance=_covariance(gyro is not None),
        linear_acceleration=_new_vector(np.zeros(3) if acceleration is None else acceleration),
        linear_acceleration_covariance=_covariance(acceleration is not None),
    )
    return serialize(message, IMU)


def _decode_imu(data: bytes, _context: _Context) -> ImuSample:
    message = plain_messages.imu(data)
    gyro = acceleration = orientation = None
    of_orientation, of_gyro, of_acceleration = message.covariances
    if of_gyro != ABSENT:
        gyro = _finite(message.gyro, "angular velocity")
    if of_acceleration != ABSENT:
        acceleration = _finite(message.acceleration, "linear acceleration")
    if of_orientation != ABSENT:
        orientation = _orientation(message.orientation)
    return ImuSample(message.stamp_ns, gyro, acceleration, orientation)


def _orientation(xyzw: Sequence[float]) -> FloatArray | None:
    """The quaternion; None where it is all zeros, as drivers leave it when they have none yet."""
    quaternion = _finite(xyzw, "orientation")
    norm = math.hypot(*xyzw)
    if norm == 0.0:
        return None
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise MessageError(f"orientation of norm {norm:.3f}, expected 1")
    return quaternion


def _encode_angles(angles: ScrewAngles, frame_id: str) -> bytes:
    message = new(
        JOINT_STATE,
        header=header(angles.stamp_ns, frame_id),
        name=list(SCREW_NAMES),
        position=np.ascontiguousarray(angles.angle, dtype=np.float64),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )
    return serialize(message, JOINT_STATE)


def _decode_joints(data: bytes, _context: _Context) -> ScrewAngles | ScrewSpeeds:
    """Angles where all four screws have a position, else the speeds of those that have a velocity."""
    message = plain_messages.joints(data)
    names, stamp_ns = message.names, message.stamp_ns
    if len(message.position) == len(names) and _SCREWS.issubset(names):
        angle = [message.position[names.index(name)] for name in SCREW_NAMES]
        return ScrewAngles(stamp_ns, _finite(angle, "position"))
    speed = np.full(4, np.nan)
    if len(message.velocity) == len(names):
        for k, name in enumerate(SCREW_NAMES):
            if name in names:
                (speed[k],) = _finite([message.velocity[names.index(name)]], "velocity")
    if np.isnan(speed).all():
        raise MessageError(f"no position of all screws and no velocity of any of {SCREW_NAMES}")
    return ScrewSpeeds(stamp_ns, speed)


def _encode_speeds(speeds: ScrewSpeeds) -> list[tuple[str, str, bytes]]:
    messages = []
    for k, name in enumerate(SCREW_NAMES):
        if not np.isfinite(speeds.speed[k]):
            continue
        message = new(
            MOTOR_FEEDBACK,
            header=header(speeds.stamp_ns, name),
            motor_id=name,
            motor_rpm=float(speeds.speed[k]) / RADIANS_PER_SECOND_PER_RPM,
            motor_current_ma=_known(speeds.current_mA, k),
            motor_voltage_v=_known(speeds.voltage_V, k),
        )
        messages.append((f"{name}/motor_module", MOTOR_FEEDBACK, serialize(message, MOTOR_FEEDBACK)))
    return messages


def _known(values: FloatArray | None, k: int) -> float:
    """The value, or the zero with which a module says that it does not measure."""
    return float(values[k]) if values is not None and np.isfinite(values[k]) else 0.0


def _decode_motor(data: bytes, context: _Context) -> ScrewSpeeds:
    message = deserialize(data, MOTOR_FEEDBACK)
    k = _screw_index(message, context.screw)
    speed = np.full(4, np.nan)
    (speed[k],) = _finite([message.motor_rpm * RADIANS_PER_SECOND_PER_RPM], "rpm")
    current = voltage = None
    # A module that does not measure leaves both at zero; a powered one never has zero volts.
    if message.motor_voltage_v != 0.0 or message.motor_current_ma != 0.0:
        current, voltage = np.full(4, np.nan), np.full(4, np.nan)
        current[k], voltage[k] = message.motor_current_ma, message.motor_voltage_v
        _finite([current[k], voltage[k]], "current or voltage")
    return ScrewSpeeds(time_to_ns(message.header.stamp), speed, current, voltage)


def _screw_index(message: Message, topic_screw: str | None) -> int:
    """RM3's modules give a number as the motor's id and the name as the frame; ours give the name."""
    motor_id = message.motor_id.strip()
    if motor_id in ("0", "1", "2", "3"):
        return int(motor_id)
    for name in (motor_id, message.header.frame_id, topic_screw):
        if name in SCREW_NAMES:
            return SCREW_NAMES.index(name)
    raise MessageError(f"motor_id {motor_id!r}, expected 0 to 3 or one of {SCREW_NAMES}")


def _encode_odometry(sample: OdometrySample, frame_id: str) -> bytes:
    vx, vy, wz = (float(value) for value in sample.velocity)
    twist = new(
        "geometry_msgs/msg/Twist",
        linear=_new_vector(np.array([vx, vy, 0.0])),
        angular=_new_vector(np.array([0.0, 0.0, wz])),
    )
    message = new(TWIST_STAMPED, header=header(sample.stamp_ns, frame_id or "base_link"), twist=twist)
    return serialize(message, TWIST_STAMPED)


def _decode_twist(data: bytes, _context: _Context) -> OdometrySample:
    stamp_ns, (vx, vy, _, _, _, wz) = plain_messages.twist(data)
    return OdometrySample(stamp_ns, _finite((vx, vy, wz), "velocity"))


def _decode_odometry(data: bytes, _context: _Context) -> OdometrySample:
    message = deserialize(data, ODOMETRY)
    twist = message.twist.twist
    velocity = (twist.linear.x, twist.linear.y, twist.angular.z)
    return OdometrySample(time_to_ns(message.header.stamp), _finite(velocity, "velocity"))


_READERS: dict[str, Callable[[bytes, _Context], Measurement]] = {
    WHISKER_ARRAY: _decode_hall,
    IMU: _decode_imu,
    JOINT_STATE: _decode_joints,
    MOTOR_FEEDBACK: _decode_motor,
    TWIST_STAMPED: _decode_twist,
    ODOMETRY: _decode_odometry,
}
