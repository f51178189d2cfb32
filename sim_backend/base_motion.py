"""How the body that carries the whiskers moves in space, as a function of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
        R = np.zeros((n, 3, 3))
        R[:, 0, 0] = R[:, 1, 1] = np.cos(motion.pose[:, 2])
        R[:, 1, 0] = np.sin(motion.pose[:, 2])
        R[:, 0, 1] = -R[:, 1, 0]
        R[:, 2, 2] = 1.0
        return BaseStates(position, R, velocity, acceleration, omega, alpha)


class FollowGround:
    """A body on the ground: its height, pitch and roll are those of the plane fitted to the ground under it.

    Heading and way are the path's. Where the ground is level at the start, base_link starts as the map's origin.
    """

    #: Places under the body that carry it, m: half the length and half the width of the screws' footprint.
    FOOTPRINT = (0.30, 0.25)
    #: Half the step of the differences that give velocity and acceleration, s.
    STEP = 0.005

    def __init__(
        self,
        path: WaypointPath,
        floor: Callable[[FloatArray, FloatArray], FloatArray],
        ride_height: float,
        touch_down: TouchDown | None = None,
    ) -> None:
        """Drive the path on a floor.

        Args:
            path: way and heading.
            floor: height of the floor at places x, y of equal shape, m.
            ride_height: of base_link's origin above the fitted plane, m; below it where negative.
            touch_down: before time 0.
        """
        self.path, self.floor, self.ride_height = path, floor, ride_height
        self._level = LevelGrid(path, touch_down or TouchDown(height=0.06))
        along, across = np.meshgrid(np.linspace(-1, 1, 3), np.linspace(-1, 1, 3))
        self._feet = np.stack([along.ravel() * self.FOOTPRINT[0], across.ravel() * self.FOOTPRINT[1]])
        #: Least squares: rows give height, slope along and slope across from the heights under the feet.
        self._fit = np.linalg.pinv(np.column_stack([np.ones(9), *self._feet]))

    @property
    def duration(self) -> float:
        """When the path has been driven, s."""
        return self.path.duration

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return self.path.length

    def at(self, time: ArrayLike) -> BaseStates:
        """The body's motion at times of shape (n,), s."""
        t = np.atleast_1d(np.asarray(time, dtype=np.float64))
        n, h = len(t), self.STEP
        position, R = self._pose(np.concatenate([t - h, t, t + h]))
        p, R = position.reshape(3, n, 3), R.reshape(3, n, 3, 3)
        ahead, behind = _small_turn(R[2] @ R[1].swapaxes(-1, -2)), _small_turn(R[1] @ R[0].swapaxes(-1, -2))
        return BaseStates(
            p[1],
            R[1],
            (p[2] - p[0]) / (2.0 * h),
            (p[2] - 2.0 * p[1] + p[0]) / h**2,
            (ahead + behind) / (2.0 * h),
            (ahead - behind) / h**2,
        )

    def _pose(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions, shape (n, 3), m, and rotations, shape (n, 3, 3)."""
        level = self._level.at(t)
        forward, left = level.R[:, :2, 0], level.R[:, :2, 1]
        feet = level.position[:, :2, None] + forward[:, :, None] * self._feet[0] + left[:, :, None] * self._feet[1]
        height, along, across = self._fit @ self.floor(feet[:, 0], feet[:, 1]).T
        up = np.stack([np.zeros_like(along), np.zeros_like(along), np.ones_like(along)], axis=-1)
        up[:, :2] = -along[:, None] * forward - across[:, None] * left
        up /= np.sqrt(np.square(up).sum(axis=-1, keepdims=True))
        ahead = np.column_stack([forward, along])
        ahead /= np.sqrt(np.square(ahead).sum(axis=-1, keepdims=True))
        R = np.stack([ahead, np.cross(up, ahead), up], axis=-1)
        position = level.position.copy()
        position[:, 2] += height + self.ride_height
        return position, R


def _small_turn(R: FloatArray) -> FloatArray:
    """Rotation vectors, shape (n, 3), rad, of turns of milliradians, to the third order."""
    return 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=-1)
