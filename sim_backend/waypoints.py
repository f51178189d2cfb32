"""Path through waypoints with a smooth start and stop on every leg: pose, velocity, acceleration over time.

The thesis's waypoint controller ran on a force-driven plugin because velocity steps upset the simulation
(Nagel 2021, section 3.4.3). Here the whole motion is a function of time, so that it is exact and repeatable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """How fast the waypoints are driven.

    Attributes:
        speed: highest speed, m/s.
        turn_rate: highest turn rate, rad/s.
        ramp: time from standstill to full speed, s; 1 s peaks at 0.225 m/s2 and lengthens a leg by 1 s.
        rest_before: standing still at the start, s.
        rest_after: standing still at the end, s.
    """

    speed: float = 0.15
    turn_rate: float = 0.4
    ramp: float = 1.0
    rest_before: float = 2.0
    rest_after: float = 1.0


@dataclass(frozen=True, slots=True)
class Motion:
    """Planar motion at some instants; arrays of shape (n, 3): x, y in the world, heading (unwrapped).

    Attributes:
        pose: m, m, rad.
        velocity: m/s, m/s, rad/s, in the world's axes.
        acceleration: m/s2, m/s2, rad/s2, in the world's axes.
    """

    pose: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


class WaypointPath:
    """Drives the waypoints one after the other; every leg is a straight line on which the heading turns along.

    The share of a leg that is behind follows a rate that rises from zero to its cruising value as
    3 s^2 - 2 s^3, stays, and falls in the same way: velocity and acceleration are continuous and zero at both
    ends. Where a leg is too short for the full rate, it ramps up and down without cruising.
    """

    def __init__(self, waypoints: ArrayLike, settings: DriveSettings | None = None) -> None:
        """Plan the path.

        Args:
            waypoints: shape (n, 3), n >= 1: x, y in m, heading in rad, unwrapped; the first is the start.
            settings: speeds and ramps.
        """
        self.settings = settings or DriveSettings()
        self.waypoints = np.asarray(waypoints, dtype=np.float64).reshape(-1, 3)
        self._step = np.diff(self.waypoints, axis=0)
        self._rate, self._leg_time = self._timing(self._step)
        #: When each leg starts, and when the last one ends, s; between two legs there may be a rest.
        self._start = self.settings.rest_before + np.concatenate([[0.0], np.cumsum(self._leg_time)])

    @property
    def duration(self) -> float:
        """Time from the start to the end, rests included, s."""
        return float(self._start[-1] + self.settings.rest_after)

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return float(np.hypot(self._step[:, 0], self._step[:, 1]).sum())

    def at(self, time: ArrayLike) -> Motion:
        """Motion at the given times since the start, shape (n,), s; before and after, it stands still."""
        t = np.atleast_1d(np.asarray(time, dtype=np.float64))
        if not len(self._step):
            still = np.zeros((len(t), 3))
            return Motion(np.broadcast_to(self.waypoints[0], (len(t), 3)).copy(), still, still.copy())
        leg = np.clip(np.searchsorted(self._start, t, side="right") - 1, 0, len(self._step) - 1)
        share, rate, change = self._progress(t - self._start[leg], leg)
        step = self._step[leg]
        return Motion(self.waypoints[leg] + share[:, None] * step, rate[:, None] * step, change[:, None] * step)

    def _timing(self, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Cruising rate of the share, 1/s, and duration, s, of legs of shape (m, 3); no length takes no time."""
        full = np.maximum(
            np.hypot(step[:, 0], step[:, 1]) / self.settings.speed, np.abs(step[:, 2]) / self.settings.turn_rate
        )
        ramp = self.settings.ramp
        rate = np.divide(1.0, np.maximum(full, ramp), where=full > 0.0, out=np.zeros_like(full))
        return rate, np.where(full > 0.0, np.maximum(full, ramp) + ramp, 0.0)

    def _progress(self, t: FloatArray, leg: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Share of the leg that is behind, its rate and the rate's change, at times since the leg's start."""
        ramp, total, cruise = self.settings.ramp, self._leg_time[leg], self._rate[leg]
        t = np.clip(t, 0.0, total)
        falling = t > 0.5 * total
        # The second half mirrors the first.
        mirrored = np.where(falling, total - t, t)
        s = np.minimum(mirrored / ramp, 1.0)
        share = cruise * (ramp * (s**3 - 0.5 * s**4) + np.maximum(mirrored - ramp, 0.0))
        rate = cruise * (3.0 * s**2 - 2.0 * s**3)
        change = cruise * (6.0 * s - 6.0 * s**2) / ramp
        behind = np.where(falling, 1.0 - share, share)
        return np.where(total > 0.0, behind, 1.0), rate, np.where(falling, -change, change)
