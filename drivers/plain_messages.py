"""Messages of few numbers, unpacked in one go: what comes most often after the whiskers themselves.

A general decoder makes an object of every nested field and takes ten times as long. Here little-endian CDR that is
plainly such a message is unpacked by one layout; all else (other byte order, text beyond ASCII, a size that does not
fit) is left to the general decoder, which says what it means, or what is wrong with it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from drivers import cdr
from drivers.ros_messages import CDR_LITTLE_ENDIAN, NANOSECONDS_PER_SECOND, deserialize, time_to_ns

IMU = "sensor_msgs/msg/Imu"
JOINT_STATE = "sensor_msgs/msg/JointState"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"

Numbers = tuple[float, ...]

#: Where the payload begins; everything is aligned from there.
START = len(CDR_LITTLE_ENDIAN)
#: What serialisers append at most.
MOST_SURPLUS = 3
#: Stamp, and the length of the frame's name.
_HEADER = struct.Struct("<iII")
#: Whole covariances are of no use here, only what their first element says.
_IMU = struct.Struct("<5d64x4d64x4d64x")
_TWIST = struct.Struct("<6d")


@dataclass(slots=True)
class PlainImu:
    """Content of a `sensor_msgs/msg/Imu`: quaternion, rate, acceleration, and the first element of each covariance."""

    stamp_ns: int
    orientation: Numbers
    gyro: Numbers
    acceleration: Numbers
    covariances: tuple[float, float, float]


@dataclass(slots=True)
class PlainJoints:
    """Content of a `sensor_msgs/msg/JointState` but for its efforts."""

    stamp_ns: int
    names: list[str]
    position: Numbers
    velocity: Numbers


def imu(data: bytes) -> PlainImu:
    """What a `sensor_msgs/msg/Imu` says.

    Raises:
        MessageError: the bytes are not one such message.
    """
    found = _after_header(data, _IMU)
    if found is not None:
        stamp_ns, v = found
        return PlainImu(stamp_ns, v[:4], v[5:8], v[9:12], (v[4], v[8], v[12]))
    message = deserialize(data, IMU)
    q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
    covariances = (
        float(message.orientation_covariance[0]),
        float(message.angular_velocity_covariance[0]),
        float(message.linear_acceleration_covariance[0]),
    )
    return PlainImu(
        time_to_ns(message.header.stamp), (q.x, q.y, q.z, q.w), (w.x, w.y, w.z), (a.x, a.y, a.z), covariances
    )


def twist(data: bytes) -> tuple[int, Numbers]:
    """Stamp, ns, linear and angular velocity, 6 numbers, of a `geometry_msgs/msg/TwistStamped`.

    Raises:
        MessageError: the bytes are not one such message.
    """
    found = _after_header(data, _TWIST)
    if found is not None:
        return found
    message = deserialize(data, TWIST_STAMPED)
    v, w = message.twist.linear, message.twist.angular
    return time_to_ns(message.header.stamp), (v.x, v.y, v.z, w.x, w.y, w.z)


def joints(data: bytes) -> PlainJoints:
    """What a `sensor_msgs/msg/JointState` says.

    Raises:
        MessageError: the bytes are not one such message.
    """
    found = _plain_joints(data)
    if found is not None:
        return found
    message = deserialize(data, JOINT_STATE)
    position, velocity = tuple(message.position.tolist()), tuple(message.velocity.tolist())
    return PlainJoints(time_to_ns(message.header.stamp), message.name, position, velocity)


def _plain_joints(data: bytes) -> PlainJoints | None:
    header = _header(data)
    if header is None:
        return None
    stamp_ns, at = header
    names: list[str] = []
    try:
        at = cdr.align(at, 4)
        (count,) = cdr.UINT32.unpack_from(data, at)
        at += 4
        for _ in range(count):
            at = cdr.align(at, 4)
            (length,) = cdr.UINT32.unpack_from(data, at)
            end = at + 4 + length
            text = data[at + 4 : end]
            if len(text) != length or not text.endswith(b"\0") or not text.isascii():
                return None
            names.append(text[:-1].decode("ascii"))
            at = end
        position, at = _sequence(data, at)
        velocity, at = _sequence(data, at)
        _, at = _sequence(data, at)
    except struct.error:
        return None
    return PlainJoints(stamp_ns, names, position, velocity) if 0 <= len(data) - at <= MOST_SURPLUS else None


def _sequence(data: bytes, at: int) -> tuple[Numbers, int]:
    """A `float64[]` and where it ends; an empty one has no padding for numbers."""
    at = cdr.align(at, 4)
    (count,) = cdr.UINT32.unpack_from(data, at)
    at += 4
    if not count:
        return (), at
    at = cdr.align(at - START, 8) + START
    if at + 8 * count > len(data):
        raise struct.error(f"{count} numbers do not fit {len(data)} bytes")
    return struct.unpack_from(f"<{count}d", data, at), at + 8 * count


def _header(data: bytes) -> tuple[int, int] | None:
    """Stamp, ns, of the header, and where that ends."""
    if len(data) < START + _HEADER.size or data[:2] != CDR_LITTLE_ENDIAN[:2]:
        return None
    sec, nanosec, length = _HEADER.unpack_from(data, START)
    begin = START + _HEADER.size
    text = data[begin : begin + length]
    if len(text) != length or not text.endswith(b"\0") or not text.isascii():
        return None
    return sec * NANOSECONDS_PER_SECOND + nanosec, begin + length


def _after_header(data: bytes, numbers: struct.Struct) -> tuple[int, Numbers] | None:
    """Stamp, ns, and the float64s that follow the header and end the message."""
    header = _header(data)
    if header is None:
        return None
    begin = cdr.align(header[1] - START, 8) + START
    if not 0 <= len(data) - begin - numbers.size <= MOST_SURPLUS:
        return None
    return header[0], numbers.unpack_from(data, begin)
