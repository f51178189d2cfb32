"""IMU samples between two events of the filter, brought to one mean rate and one mean acceleration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ImuSample

FloatArray = NDArray[np.float64]

#: An IMU that is silent for longer is not one to lean on.
MAX_GAP_NS = 100_000_000


class ImuBatch:
    """Integrates angular rates at their own times; the last sample holds until the next.

    Attributes:
        samples: with a rate, taken since the last `mean_rate`.
        orientation_xyzw: the last attitude of the IMU itself, if it has one.
    """

    def __init__(self) -> None:
        self.samples = 0
        self.orientation_xyzw: FloatArray | None = None
        self._integral = np.zeros(3)
        self._last: FloatArray | None = None
        self._sample_ns = self._from_ns = self._until_ns = 0
        self._acceleration, self._accelerations = np.zeros(3), 0

    def add(self, sample: ImuSample) -> None:
        """Take a sample in base_link's axes; stamps ascend."""
        if sample.acceleration is not None:
            self._acceleration = self._acceleration + sample.acceleration
            self._accelerations += 1
        if sample.orientation_xyzw is not None:
            self.orientation_xyzw = sample.orientation_xyzw
        if sample.gyro is None:
            return
        stamp = sample.stamp_ns
        if self._last is None or stamp - self._sample_ns > MAX_GAP_NS:
            self._from_ns = self._until_ns = stamp
            self._integral = np.zeros(3)
        elif stamp > self._until_ns:
            self._integral = self._integral + (self._last + sample.gyro) * (0.5e-9 * (stamp - self._until_ns))
            self._until_ns = stamp
        self._last, self._sample_ns = sample.gyro, stamp
        self.samples += 1

    def mean_rate(self, from_ns: int, until_ns: int) -> FloatArray | None:
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

    def mean_acceleration(self) -> FloatArray | None:
        """Mean acceleration since the last call, m/s2, shape (3,); None without samples."""
        if not self._accelerations:
            return None
        mean: FloatArray = self._acceleration / self._accelerations
        self._acceleration, self._accelerations = np.zeros(3), 0
        return mean
