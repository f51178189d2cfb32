"""Where a simulator knows the truth: the body's pose as Odometry and the whiskers' contacts as PointCloud2."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import FloatArray
from drivers.ros_messages import Message, MessageError, deserialize, header, new, serialize, time_to_ns

TYPENAME = "nav_msgs/msg/Odometry"
WHISKERS_TYPENAME = "sensor_msgs/msg/PointCloud2"
#: One whisker as a point; the byte after `contact` is padding.
WHISKER_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "index", "contact", "inclination", "azimuth", "hinge_x", "hinge_y", "arm"],
        "formats": ["<f4", "<f4", "<f4", "<u2", "u1", "<f4", "<f4", "<f4", "<f4", "<f4"],
        "offsets": [0, 4, 8, 12, 14, 16, 20, 24, 28, 32],
        "itemsize": 36,
    }
)
#: sensor_msgs/PointField: numbers of the data types in use.
_DATATYPES = {"|u1": 2, "<u2": 4, "<f4": 7}


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """The true state at a time.

    Attributes:
        stamp_ns: time on the clock that published stamps use.
        pose: T_map_base as x y z (m), qx qy qz qw; shape (7,).
        twist: velocity of base_link in base_link: vx vy vz (m/s), wx wy wz (rad/s); shape (6,).
    """

    stamp_ns: int
    pose: FloatArray
    twist: FloatArray


@dataclass(frozen=True, slots=True)
class WhiskerTruth:
    """What every whisker of a frame really did when its sensor was read.

    Attributes:
        stamp_ns: of the frame it belongs to.
        contact: whether something presses on the rod, shape (n,).
        point: where, in base_link as it was at that sensor's reading, shape (n, 3), m; NaN without contact.
        arm: distance along the rod from the joint to the contact, shape (n,), m; NaN without contact.
        inclination, azimuth: of the rod in its whisker frame, shape (n,), rad.
        hinge: angles about x and y, shape (n, 2), rad.
    """

    stamp_ns: int
    contact: NDArray[np.bool_]
    point: FloatArray
    arm: FloatArray
    inclination: FloatArray
    azimuth: FloatArray
    hinge: FloatArray


def _vector(values: FloatArray) -> Message:
    return new("geometry_msgs/msg/Vector3", x=float(values[0]), y=float(values[1]), z=float(values[2]))


def encode(truth: GroundTruth) -> bytes:
    """nav_msgs/Odometry as CDR, frame map, child frame base_link, covariances zero."""
    x, y, z, qx, qy, qz, qw = (float(value) for value in truth.pose)
    pose = new(
        "geometry_msgs/msg/Pose",
        position=new("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
    twist = new("geometry_msgs/msg/Twist", linear=_vector(truth.twist[:3]), angular=_vector(truth.twist[3:]))
    covariance = np.zeros(36)
    message = new(
        TYPENAME,
        header=header(truth.stamp_ns, "map"),
        child_frame_id="base_link",
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance),
    )
    return serialize(message, TYPENAME)


def decode(data: bytes) -> GroundTruth:
    """The truth in a nav_msgs/Odometry.

    Raises:
        MessageError: no such message, a number that is not finite, or a quaternion of no length.
    """
    message = deserialize(data, TYPENAME)
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    pose = np.array([position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w])
    twist = np.array([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
    if not (np.isfinite(pose).all() and np.isfinite(twist).all()):
        raise MessageError("ground truth with a number that is not finite")
    norm = float(np.linalg.norm(pose[3:]))
    if norm < 1e-6:
        raise MessageError("ground truth with a quaternion of no length")
    return GroundTruth(time_to_ns(message.header.stamp), pose, twist)


@cache
def _point_fields() -> list[Message]:
    return [
        new("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=_DATATYPES[dtype.str], count=1)
        for name, (dtype, offset, *_) in (WHISKER_POINT.fields or {}).items()
    ]


def encode_whiskers(truth: WhiskerTruth) -> bytes:
    """sensor_msgs/PointCloud2 as CDR: one point for each whisker, in base_link."""
    count = len(truth.contact)
    points = np.zeros(count, dtype=WHISKER_POINT)
    points["x"], points["y"], points["z"] = truth.point.T
    points["index"] = np.arange(count)
    points["contact"] = truth.contact
    points["inclination"], points["azimuth"] = truth.inclination, truth.azimuth
    points["hinge_x"], points["hinge_y"] = truth.hinge.T
    points["arm"] = truth.arm
    message = new(
        WHISKERS_TYPENAME,
        header=header(truth.stamp_ns, "base_link"),
        height=1,
        width=count,
        fields=_point_fields(),
        is_bigendian=False,
        point_step=WHISKER_POINT.itemsize,
        row_step=WHISKER_POINT.itemsize * count,
        data=np.frombuffer(points.tobytes(), dtype=np.uint8),
        # Whiskers without contact have points that are not finite.
        is_dense=False,
    )
    return serialize(message, WHISKERS_TYPENAME)


def decode_whiskers(data: bytes) -> WhiskerTruth:
    """The truth in a message that `encode_whiskers` made.

    Raises:
        MessageError: no such message, or a cloud of other points.
    """
    message = deserialize(data, WHISKERS_TYPENAME)
    expected = [(field.name, field.offset, field.datatype) for field in _point_fields()]
    if [(field.name, field.offset, field.datatype) for field in message.fields] != expected or message.is_bigendian:
        raise MessageError(f"a cloud whose points are not of {', '.join(WHISKER_POINT.names or ())}")
    if len(message.data) != message.width * WHISKER_POINT.itemsize:
        raise MessageError(f"a cloud of {message.width} points in {len(message.data)} bytes")
    points = np.frombuffer(message.data.tobytes(), dtype=WHISKER_POINT)
    if (points["index"] != np.arange(len(points))).any():
        raise MessageError("a cloud whose points are not the whiskers in their order")

    def columns(*names: str) -> FloatArray:
        return np.stack([points[name] for name in names], axis=-1).astype(np.float64)

    return WhiskerTruth(
        time_to_ns(message.header.stamp),
        points["contact"] != 0,
        columns("x", "y", "z"),
        columns("arm")[:, 0],
        columns("inclination")[:, 0],
        columns("azimuth")[:, 0],
        columns("hinge_x", "hinge_y"),
    )
