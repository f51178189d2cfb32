"""IMU samples between two events of the filter, brought to one mean rate and one mean acceleration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ImuSample
from robominer_slam.estimation.tilt import Vector

FloatArray = NDArray[np.float64]

ZERO: Vector = (0.0, 0.0, 0.0)

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
        self._integral = ZERO
        self._last: Vector | None = None
        self._sample_ns = self._from_ns = self._until_ns = 0
        self._acceleration, self._accelerations = ZERO, 0

    def add(self, sample: ImuSample) -> None:
        """Take a sample in base_link's axes; stamps ascend."""
        if sample.acceleration is not None:
            x, y, z = self._acceleration
            ax, ay, az = sample.acceleration.tolist()
            self._acceleration = (x + ax, y + ay, z + az)
            self._accelerations += 1
        if sample.orientation_xyzw is not None:
            self.orientation_xyzw = sample.orientation_xyzw
        if sample.gyro is None:
            return
        stamp, last = sample.stamp_ns, self._last
        wx, wy, wz = sample.gyro.tolist()
        if last is None or stamp - self._sample_ns > MAX_GAP_NS:
            self._from_ns = self._until_ns = stamp
            self._integral = ZERO
        elif stamp > self._until_ns:
            x, y, z = self._integral
            half = 0.5e-9 * (stamp - self._until_ns)
            self._integral = (x + (last[0] + wx) * half, y + (last[1] + wy) * half, z + (last[2] + wz) * half)
            self._until_ns = stamp
        self._last, self._sample_ns = (wx, wy, wz), stamp
        self.samples += 1

    def mean_rate(self, from_ns: int, until_ns: int) -> Vector | None:
        """Mean rate from the last call's end to `until_ns`, rad/s; None if samples do not cover it."""
        last = self._last
        if last is None or until_ns - self._sample_ns > MAX_GAP_NS:
            return None
        x, y, z = self._integral
        if until_ns > self._until_ns:
            ahead = 1e-9 * (until_ns - self._until_ns)
            x, y, z = x + last[0] * ahead, y + last[1] * ahead, z + last[2] * ahead
            self._until_ns = until_ns
        span = self._until_ns - self._from_ns
        rate = last
        if span > 0:
            per_second = 1e9 / span
            rate = (x * per_second, y * per_second, z * per_second)
        covered = self._from_ns <= from_ns + MAX_GAP_NS
        self._from_ns, self._integral, self.samples = self._until_ns, ZERO, 0
        return rate if covered else None

    def mean_acceleration(self) -> Vector | None:
        """Mean acceleration since the last call, m/s2; None without samples."""
        count = self._accelerations
        if not count:
            return None
        x, y, z = self._acceleration
        self._acceleration, self._accelerations = ZERO, 0
        return x / count, y / count, z / count
