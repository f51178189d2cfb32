"""How the body that carries the whiskers moves in space, as a function of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from sim_backend.waypoints import WaypointPath

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BaseStates:
    """Motion of base_link in the map frame at n instants.

    Attributes:
        position: shape (n, 3), m.
        R: rotations, base_link to map, shape (n, 3, 3).
        velocity, acceleration: of base_link's origin, map axes, shape (n, 3), m/s, m/s2.
        omega, alpha: angular velocity and acceleration, map axes, shape (n, 3), rad/s, rad/s2.
    """

    position: FloatArray
    R: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    omega: FloatArray
    alpha: FloatArray


class BaseMotion(Protocol):
    """Anything that says where the body is at a time; at negative times it comes to its start."""

    @property
    def duration(self) -> float:
        """When the drive is over, s."""

    @property
    def length(self) -> float:
        """Length of the way, m."""

    def at(self, time: ArrayLike) -> BaseStates:
        """The body's motion at times of shape (n,), s; 0 is the start of the drive."""


@dataclass(frozen=True, slots=True)
class TouchDown:
    """How whiskers that hang free are laid on the ground before the drive begins.

    The grid comes down while it moves forward, so that the whiskers trail behind it, as they do on a robot that
    has driven to its start.

    Attributes:
        time: how long it takes, s.
        height: how much higher the grid starts, m.
        run_up: how far behind its start it starts, m.
    """

    time: float = 3.0
    height: float = 0.13
    run_up: float = 0.3


class LevelGrid:
    """The thesis's grid: driven in x, y and heading, kept level at z = 0 (Nagel 2021, section 3.1)."""

    def __init__(self, path: WaypointPath, touch_down: TouchDown | None = None) -> None:
        """Drive the path; before time 0, touch down."""
        self.path = path
        self.touch_down = touch_down or TouchDown()

    @property
    def duration(self) -> float:
        """When the path has been driven, s."""
        return self.path.duration

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return self.path.length

    def at(self, time: ArrayLike) -> BaseStates:
        """The grid's motion at times of shape (n,), s."""
        t = np.atleast_1d(np.asarray(time, dtype=np.float64))
        motion = self.path.at(t)
        n = len(t)
        position, velocity, acceleration = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        position[:, :2] = motion.pose[:, :2]
        velocity[:, :2] = motion.velocity[:, :2]
        acceleration[:, :2] = motion.acceleration[:, :2]
        early = t < 0.0
        if early.any():
            heading = motion.pose[0, 2]
            down = self.touch_down
            offset = np.array([-down.run_up * np.cos(heading), -down.run_up * np.sin(heading), down.height])
            # What is left of the way: 1 at the beginning, 0 at time 0, smooth at both ends.
            s = np.clip(-t[early] / down.time, 0.0, 1.0)
            position[early] += np.outer(3 * s**2 - 2 * s**3, offset)
            velocity[early] += np.outer((6 * s**2 - 6 * s) / down.time, offset)
            acceleration[early] += np.outer((6 - 12 * s) / down.time**2 * (s < 1.0), offset)
        omega, alpha = np.zeros((n, 3)), np.zeros((n, 3))
        omega[:, 2], alpha[:, 2] = motion.velocity[:, 2], motion.acceleration[:, 2]
        R = Rotation.from_rotvec(motion.pose * [0.0, 0.0, 1.0]).as_matrix()
        return BaseStates(position, R, velocity, acceleration, omega, alpha)
