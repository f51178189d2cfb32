"""Speeds of the four screws: from angles read one after the other, or reported one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ScrewAngles, ScrewSpeeds

FloatArray = NDArray[np.float64]

#: RM3's boards report every 0.2 s; one that is silent for two and a half reports is not known any more.
MAX_AGE_NS = 500_000_000
#: A gap between two readings of angles longer than this has no meaningful mean speed.
MAX_INTERVAL_S = 0.5


class ScrewAngleSpeeds:
    """Mean speeds between readings of the screws' cumulative angles.

    Readings that follow each other closely may wait: the angles add up, so the next one tells all of it.

    Args:
        least_interval_ns: readings sooner than this after the last one used wait for the next, or for `waiting`.

    Attributes:
        stale: readings that gave none, out of order or after a gap.
        readings: how many readings the last speeds are of.
    """

    def __init__(self, least_interval_ns: int = 0) -> None:
        self._least_interval_ns = least_interval_ns
        self._before: ScrewAngles | None = None
        self._waiting: ScrewAngles | None = None
        self._waited = 0
        self.stale = 0
        self.readings = 0

    def add(self, reading: ScrewAngles) -> FloatArray | None:
        """Speeds since the last reading used, shape (4,), rad/s; None for the first and where the gap is too long."""
        before = self._before
        if before is not None and 0 < reading.stamp_ns - before.stamp_ns < self._least_interval_ns:
            self._waiting = reading
            self._waited += 1
            return None
        return self._use(reading)

    def waiting(self) -> tuple[int, FloatArray | None] | None:
        """Use the reading that waits: its stamp, ns, and the speeds; None where none waits."""
        reading = self._waiting
        if reading is None:
            return None
        self._waited -= 1
        return reading.stamp_ns, self._use(reading)

    def _use(self, reading: ScrewAngles) -> FloatArray | None:
        before, self._before = self._before, reading
        self.readings, self._waited, self._waiting = self._waited + 1, 0, None
        if before is None:
            return None
        interval = (reading.stamp_ns - before.stamp_ns) * 1e-9
        if not 0.0 < interval <= MAX_INTERVAL_S:
            self.stale += 1
            return None
        speed: FloatArray = (reading.angle - before.angle) / interval
        return speed


class ScrewSpeedAssembly:
    """Keeps the last speed of each screw until every screw has reported anew."""

    def __init__(self) -> None:
        self._speed = np.full(4, np.nan)
        self._stamps = [0, 0, 0, 0]
        self._heard = [False, False, False, False]

    def add(self, speeds: ScrewSpeeds) -> FloatArray | None:
        """Take speeds of some or all screws.

        Returns:
            All four, shape (4,), rad/s, once each has reported since the last time; None otherwise. So no report is
            used twice, and nothing comes while a screw is silent.
        """
        for k in range(4):
            if np.isfinite(speeds.speed[k]):
                self._speed[k] = speeds.speed[k]
                self._stamps[k] = speeds.stamp_ns
                self._heard[k] = True
        if not all(self._heard) or not self.complete(speeds.stamp_ns):
            return None
        self._heard = [False, False, False, False]
        return self._speed.copy()

    def complete(self, stamp_ns: int) -> bool:
        """Whether all four screws have been heard of lately."""
        return not np.isnan(self._speed).any() and stamp_ns - min(self._stamps) <= MAX_AGE_NS
