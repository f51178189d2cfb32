"""What dead reckoning knows at one time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import Measurement

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OdometryState:
    """Pose and motion of base_link in `odom`.

    Attributes:
        stamp_ns: the time it holds for.
        x, y, yaw: pose in odom, m and rad; the body is level: z, roll and pitch are zero.
        velocity: body velocity vx, vy (m/s), wz (rad/s), shape (3,).
        covariance: of (x, y, yaw) in odom, shape (3, 3).
        velocity_covariance: of the velocity, shape (3, 3).
    """

    stamp_ns: int
    x: float
    y: float
    yaw: float
    velocity: FloatArray
    covariance: FloatArray
    velocity_covariance: FloatArray


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
