"""Gyro samples between two events of the filter, brought to one mean rate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: A gyro that is silent for longer is not one to lean on.
MAX_GAP_NS = 100_000_000


class GyroBatch:
    """Integrates angular rates at their own times; the last sample holds until the next.

    Attributes:
        samples: taken since the last `mean`.
    """

    def __init__(self) -> None:
        self.samples = 0
        self._integral = np.zeros(3)
        self._last: FloatArray | None = None
        self._sample_ns = 0
        self._from_ns = 0
        self._until_ns = 0

    def add(self, stamp_ns: int, gyro: FloatArray) -> None:
        """Take a sample, rad/s, shape (3,); stamps ascend."""
        if self._last is None or stamp_ns - self._sample_ns > MAX_GAP_NS:
            self._from_ns = self._until_ns = stamp_ns
            self._integral = np.zeros(3)
        elif stamp_ns > self._until_ns:
            self._integral = self._integral + (self._last + gyro) * (0.5e-9 * (stamp_ns - self._until_ns))
            self._until_ns = stamp_ns
        self._last, self._sample_ns = gyro, stamp_ns
        self.samples += 1

    def mean(self, from_ns: int, until_ns: int) -> FloatArray | None:
        """Mean rate from the last call's end to `until_ns`, rad/s, shape (3,); None if samples do not cover it."""
        if self._last is None or until_ns - self._sample_ns > MAX_GAP_NS:
            return None
        if until_ns > self._until_ns:
            self._integral = self._integral + self._last * (1e-9 * (until_ns - self._until_ns))
            self._until_ns = until_ns
        span = self._until_ns - self._from_ns
        rate = self._integral * (1e9 / span) if span > 0 else self._last
        covered = self._from_ns <= from_ns + MAX_GAP_NS
        self._from_ns, self._integral, self.samples = self._until_ns, np.zeros(3), 0
        return rate if covered else None
