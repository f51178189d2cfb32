"""The simulated IMU: gyro and accelerometer of a BNO080's grade, in base_link's axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.base_motion import BaseStates
from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]

GRAVITY = 9.81


@dataclass(frozen=True, slots=True)
class ImuSettings:
    """Noise and bias of the IMU.

    Attributes:
        rate: samples per second, Hz.
        gyro_noise: per sample, one standard deviation, rad/s.
        gyro_bias: constant, one standard deviation per axis, rad/s.
        gyro_bias_drift: random walk of the bias, rad/s per square root of a second.
        acceleration_noise: per sample, one standard deviation, m/s2.
        acceleration_bias: constant, one standard deviation per axis, m/s2.
    """

    rate: float = 100.0
    gyro_noise: float = 0.003
    gyro_bias: float = float(np.deg2rad(0.05))
    gyro_bias_drift: float = 2e-5
    acceleration_noise: float = 0.05
    acceleration_bias: float = 0.03


class Imu:
    """Draws its biases once from the seed, then turns true motion into samples, in order."""

    def __init__(self, seed: int, settings: ImuSettings | None = None) -> None:
        """Switch the IMU on."""
        self.settings = settings or ImuSettings()
        self._rng = stream(seed, "imu")
        self._gyro_bias = self._rng.normal(0.0, self.settings.gyro_bias, 3)
        self._acceleration_bias = self._rng.normal(0.0, self.settings.acceleration_bias, 3)

    def sample(self, motion: BaseStates) -> tuple[FloatArray, FloatArray]:
        """Samples at n instants, one sampling interval apart.

        Returns:
            Angular rate, shape (n, 3), rad/s, and specific force, shape (n, 3), m/s2 (+9.81 on z at rest), both in
            base_link's axes.
        """
        s, n = self.settings, len(motion.position)
        walk = self._rng.normal(0.0, s.gyro_bias_drift / np.sqrt(s.rate), (n, 3)).cumsum(axis=0)
        bias = self._gyro_bias + walk
        self._gyro_bias = bias[-1]
        force = motion.acceleration + np.array([0.0, 0.0, GRAVITY])
        gyro = np.einsum("nji,nj->ni", motion.R, motion.omega) + bias
        acceleration = np.einsum("nji,nj->ni", motion.R, force) + self._acceleration_bias
        gyro += self._rng.normal(0.0, s.gyro_noise, (n, 3))
        acceleration += self._rng.normal(0.0, s.acceleration_noise, (n, 3))
        return gyro, acceleration
