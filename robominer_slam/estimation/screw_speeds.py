"""Speeds of screws that are reported one by one, brought together to all four."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ScrewSpeeds

FloatArray = NDArray[np.float64]

#: RM3's boards report every 0.2 s; one that is silent for two and a half reports is not known any more.
MAX_AGE_NS = 500_000_000


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
