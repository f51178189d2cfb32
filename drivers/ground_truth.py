"""Where a simulator knows the truth: pose of base_link in map, as nav_msgs/Odometry in recordings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.measurement import FloatArray
from drivers.ros_messages import Message, MessageError, deserialize, header, new, serialize, time_to_ns

TYPENAME = "nav_msgs/msg/Odometry"


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
