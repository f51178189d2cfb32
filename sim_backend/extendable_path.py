"""A waypoint path that grows while it is driven."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_backend.waypoints import DriveSettings, Motion, WaypointPath

FloatArray = NDArray[np.float64]


class PathClosedError(RuntimeError):
    """The drive's end has been computed already: no waypoint can follow."""


@dataclass(frozen=True, slots=True)
class Leg:
    """An appended leg: its end, shape (3,), x, y in m, unwrapped heading in rad; its first and last moment, s."""

    waypoint: FloatArray
    start: float
    end: float


class ExtendablePath(WaypointPath):
    """A path to which waypoints are appended while an engine and the sensors compute ahead along it.

    What has been asked for stays as it was told: a new leg starts where the last one ends, and not before the
    latest time that `at` has been called with. Until then the body stands still. One thread may drive along the
    path while others append to it.
    """

    def __init__(self, waypoints: ArrayLike, settings: DriveSettings | None = None, *, waits: bool = False) -> None:
        """Plan the path as far as it is known.

        Args:
            waypoints: shape (n, 3), n >= 1: x, y in m, heading in rad, unwrapped; the first is the start.
            settings: speeds and ramps.
            waits: whether the body waits for more at the end; it does too once a waypoint has been appended.
        """
        super().__init__(waypoints, settings)
        self._lock = threading.RLock()
        self._waits, self._closed = waits, False
        self._asked = 0.0

    @property
    def duration(self) -> float:
        """Time from the start to the end, rests included, s; infinite while the body waits for waypoints."""
        with self._lock:
            return math.inf if self._waits else super().duration

    def at(self, time: ArrayLike) -> Motion:
        """See `WaypointPath.at`; what is told here is not changed any more."""
        t = np.asarray(time, dtype=np.float64)
        with self._lock:
            self._asked = max(self._asked, float(t.max(initial=0.0)))
            return super().at(t)

    def last_waypoint(self) -> FloatArray:
        """Where the last leg ends, shape (3,): x, y in m, unwrapped heading in rad."""
        with self._lock:
            last: FloatArray = self.waypoints[-1].copy()
            return last

    def extend(self, x: float, y: float, heading: float) -> Leg:
        """Append a waypoint, m, m, rad; the body turns the shorter way round, and waits there for more.

        Raises:
            PathClosedError: the end of the drive has been computed.
        """
        with self._lock:
            if self._closed:
                raise PathClosedError("the drive has ended")
            turn = np.remainder(heading - self.waypoints[-1, 2] + np.pi, 2.0 * np.pi) - np.pi
            waypoint = np.array([x, y, self.waypoints[-1, 2] + turn])
            step = (waypoint - self.waypoints[-1])[None]
            rate, leg_time = self._timing(step)
            start = max(float(self._start[-1]), self._asked)
            end = start + float(leg_time[0])
            self._start = np.concatenate([self._start[:-1], [start, end]])
            self.waypoints = np.vstack([self.waypoints, waypoint])
            self._step = np.vstack([self._step, step])
            self._rate, self._leg_time = np.append(self._rate, rate), np.append(self._leg_time, leg_time)
            self._waits = True
            return Leg(waypoint, start, end)

    def finish(self) -> float:
        """Wait for no more waypoints; returns when the drive will be over, s."""
        with self._lock:
            self._waits = False
            # Who waited has computed beyond the end: the drive is over there.
            return max(self.duration, self._asked)

    def close(self, time: float) -> bool:
        """Take no more waypoints if the drive is over by `time`, s; whether it is."""
        with self._lock:
            self._closed = self._closed or self.duration <= time
            return self._closed
