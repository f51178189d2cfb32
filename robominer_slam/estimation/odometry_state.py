"""What dead reckoning knows at one time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import Measurement
from robominer_slam.contacts import Contacts
from robominer_slam.estimation.keyframe_motion import KeyframeMotion

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OdometryState:
    """Pose and motion of base_link in `odom`.

    Attributes:
        stamp_ns: the time it holds for.
        x, y, yaw: pose in odom, m and rad.
        velocity: body velocity vx, vy (m/s), wz (rad/s), shape (3,).
        covariance: of (x, y, yaw) in odom, shape (3, 3).
        velocity_covariance: of the velocity, shape (3, 3).
        T_odom_base: pose in odom with z, roll and pitch, shape (4, 4); None where the body is taken as level.
        pose_covariance: of x, y, z, roll, pitch, yaw in odom, shape (6, 6); None likewise.
    """

    stamp_ns: int
    x: float
    y: float
    yaw: float
    velocity: FloatArray
    covariance: FloatArray
    velocity_covariance: FloatArray
    T_odom_base: FloatArray | None = None
    pose_covariance: FloatArray | None = None


def planar_pose(state: OdometryState) -> FloatArray:
    """Pose of base_link in odom, shape (4, 4): in space where it is known so, else in the plane."""
    if state.T_odom_base is not None:
        return state.T_odom_base
    c, s = math.cos(state.yaw), math.sin(state.yaw)
    return np.array([[c, -s, 0.0, state.x], [s, c, 0.0, state.y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


class DeadReckoning(Protocol):
    """Takes measurements in the order of their stamps; says where the robot is."""

    def add(self, measurement: Measurement) -> None:
        """Take a measurement; kinds that are of no use here are ignored."""
        ...

    def measures_motion(self, measurement: Measurement) -> bool:
        """Whether this kind of measurement says how fast the robot moves: without it, the pose is soon not known."""
        ...

    def state_at(self, stamp_ns: int) -> OdometryState:
        """The state at a time that is not before the last measurement's."""
        ...


@runtime_checkable
class FeelsMotion(Protocol):
    """Dead reckoning that takes the whiskers' contacts too."""

    def add_contacts(self, stamp_ns: int, contacts: Contacts) -> None:
        """Take the contacts of a whisker frame, in base_link; `state_at` then knows of them."""
        ...


@runtime_checkable
class TellsMotion(Protocol):
    """Dead reckoning that tells the noise of the motion between keyframes from its biases."""

    def mark_keyframe(self, stamp_ns: int) -> KeyframeMotion:
        """Motion since the last mark (or the start); the present pose becomes the new reference."""
        ...


@runtime_checkable
class TakesScanMatches(Protocol):
    """Dead reckoning that scan matching can correct."""

    def correct_pose(self, stamp_ns: int, offset: FloatArray, information: FloatArray) -> None:
        """Take what a scan match says of (x, y, yaw) in odom: offset, shape (3,), and its information (3, 3)."""
        ...

    def relative_covariance(self) -> FloatArray:
        """Covariance of (x, y, yaw) since the last keyframe, in odom, shape (3, 3)."""
        ...
