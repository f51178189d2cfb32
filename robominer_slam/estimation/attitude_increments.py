"""Turn rate of an IMU that has an attitude and no gyro: the increments of its attitude.

The rate is the mean since the sample before, log(q_before^-1 q) / dt, in the IMU's own axes. Its yaw is relative and
drifts, as a gyro's integral does, so only increments are of use. Steps of 0.01 deg at 100 Hz make the rate coarse,
but what one increment lacks the next has: the sum stays right.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ImuSample

FloatArray = NDArray[np.float64]

#: After a longer gap the mean rate says little; the increment is left out and counted.
MAX_INTERVAL_S = 0.5


class AttitudeIncrements:
    """Fills in the gyro of one IMU's samples, in the order of their stamps.

    Attributes:
        gaps: increments left out because of a gap.
    """

    def __init__(self) -> None:
        self._before: tuple[int, FloatArray] | None = None
        self.gaps = 0

    def with_rate(self, sample: ImuSample) -> ImuSample:
        """The sample with the mean rate since the last one; as it was where it has a gyro or no attitude."""
        xyzw = sample.orientation_xyzw
        if sample.gyro is not None or xyzw is None:
            return sample
        before, self._before = self._before, (sample.stamp_ns, xyzw)
        if before is None:
            return sample
        interval = (sample.stamp_ns - before[0]) * 1e-9
        if not 0.0 < interval <= MAX_INTERVAL_S:
            self.gaps += 1
            return sample
        return replace(sample, gyro=rotation_between(before[1], xyzw) / interval)


def rotation_between(q_before: FloatArray, q_after: FloatArray) -> FloatArray:
    """Rotation vector, shape (3,), rad, from one attitude (x y z w) to another, in the axes of the first."""
    x, y, z, w = (-q_before[0], -q_before[1], -q_before[2], q_before[3])
    a, b, c, d = q_after
    vector = np.array([w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a, w * c + x * b - y * a + z * d])
    scalar = w * d - x * a - y * b - z * c
    if scalar < 0.0:
        # Both quaternions mean the same attitude: take the short way.
        vector, scalar = -vector, -scalar
    sine = float(np.sqrt(vector @ vector))
    # Near zero 2 asin(s) / s is 2.
    factor = 2.0 * np.arctan2(sine, scalar) / sine if sine > 1e-12 else 2.0
    rotation: FloatArray = factor * vector
    return rotation
