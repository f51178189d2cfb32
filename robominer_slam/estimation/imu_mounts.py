"""IMU samples as the estimator takes them: in base_link's axes, with a rate wherever one can be had."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ImuSample
from robominer_slam import geometry
from robominer_slam.estimation.attitude_increments import AttitudeIncrements

FloatArray = NDArray[np.float64]


class ImuMounts:
    """How each device's IMU is mounted, and the attitudes of those that have no gyro.

    Args:
        rotations: of each device's IMU in base_link, shape (3, 3), by device name; those left out are mounted straight.
    """

    def __init__(self, rotations: Mapping[str, FloatArray]) -> None:
        self._rotations = rotations
        self._increments: defaultdict[str, AttitudeIncrements] = defaultdict(AttitudeIncrements)

    def in_base(self, device: str, sample: ImuSample) -> ImuSample:
        """The device's sample in base_link's axes; a gyro that it lacks is made of its attitudes."""
        if sample.gyro is None:
            sample = self._increments[device].with_rate(sample)
        R = self._rotations.get(device)
        if R is None:
            return sample
        return replace(
            sample,
            gyro=None if sample.gyro is None else R @ sample.gyro,
            acceleration=None if sample.acceleration is None else R @ sample.acceleration,
            orientation_xyzw=None if sample.orientation_xyzw is None else _turned(sample.orientation_xyzw, R),
        )


def _turned(xyzw: FloatArray, R_base_imu: FloatArray) -> FloatArray:
    """Attitude of base_link from that of an IMU mounted in it."""
    return geometry.matrix_to_quaternion(geometry.quaternion_to_matrix(xyzw) @ R_base_imu.T)
