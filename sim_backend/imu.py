"""IMU: angular rate and specific force with noise, biases and steps, in the axes in which it is mounted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_backend.base_motion import BaseStates
from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]

GRAVITY = 9.81


@dataclass(frozen=True, slots=True)
class ImuSettings:
    """Noise, bias and mounting of the IMU; the defaults are a BNO080's, the worse of the robot's two.

    Attributes:
        rate: samples per second, Hz.
        gyro_noise: per sample, one standard deviation, rad/s.
        gyro_bias: constant, one standard deviation per axis, rad/s.
        gyro_bias_drift: random walk of the bias, rad/s per square root of a second.
        gyro_step: of the digital output, rad/s; 0: none.
        acceleration_noise: per sample, one standard deviation, m/s2.
        acceleration_bias: constant, one standard deviation per axis, m/s2.
        acceleration_step: of the digital output, m/s2; 0: none.
        mount_rpy_deg: rotation of the IMU in base_link: yaw, then pitch, then roll.
        gravity_free: as the robot's own topic: gravity has been taken out of the acceleration.
    """

    rate: float = 100.0
    gyro_noise: float = 0.003
    gyro_bias: float = float(np.deg2rad(0.05))
    gyro_bias_drift: float = 2e-5
    gyro_step: float = 1.0 / 512.0  # BNO080: Q point 9
    acceleration_noise: float = 0.05
    acceleration_bias: float = 0.03
    acceleration_step: float = 1.0 / 256.0  # BNO080: Q point 8
    mount_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gravity_free: bool = False


#: Grades by name. 3DM-CV7-AHRS: angle random walk 0.3 deg/sqrt(h), 30 ug/sqrt(Hz), bias 1.5 deg/h, floats on the line.
GRADES = {
    "bno080": ImuSettings(),
    "3dm-cv7": ImuSettings(
        gyro_noise=0.0009,
        gyro_bias=float(np.deg2rad(1.5 / 3600.0)),
        gyro_bias_drift=1e-6,
        gyro_step=0.0,
        acceleration_noise=0.003,
        acceleration_bias=0.02,
        acceleration_step=0.0,
    ),
}


class Imu:
    """Draws its biases once from the seed, then turns true motion into samples, in order."""

    def __init__(self, seed: int, settings: ImuSettings | None = None) -> None:
        """Switch the IMU on."""
        self.settings = settings or ImuSettings()
        self._rng = stream(seed, "imu")
        self._gyro_bias = self._rng.normal(0.0, self.settings.gyro_bias, 3)
        self._acceleration_bias = self._rng.normal(0.0, self.settings.acceleration_bias, 3)
        roll, pitch, yaw = self.settings.mount_rpy_deg
        self._R_base_imu: FloatArray = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()

    def gravity(self, motion: BaseStates) -> FloatArray:
        """What gravity adds to the reading at n instants, shape (n, 3), m/s2, in the IMU's axes."""
        if self.settings.gravity_free:
            return np.zeros((len(motion.R), 3))
        upwards: FloatArray = GRAVITY * motion.R[:, 2, :] @ self._R_base_imu
        return upwards

    def sample(self, motion: BaseStates) -> tuple[FloatArray, FloatArray]:
        """Samples at n instants, one sampling interval apart.

        Returns:
            Angular rate, shape (n, 3), rad/s, and specific force, shape (n, 3), m/s2 (+9.81 on z at rest; without
            gravity where the settings say so), both in the IMU's axes.
        """
        s, n = self.settings, len(motion.position)
        walk = self._rng.normal(0.0, s.gyro_bias_drift / np.sqrt(s.rate), (n, 3)).cumsum(axis=0)
        bias = self._gyro_bias + walk
        self._gyro_bias = bias[-1]
        gyro = np.einsum("nji,nj->ni", motion.R, motion.omega) @ self._R_base_imu + bias
        moved = np.einsum("nji,nj->ni", motion.R, motion.acceleration) @ self._R_base_imu
        acceleration = moved + self.gravity(motion) + self._acceleration_bias
        gyro += self._rng.normal(0.0, s.gyro_noise, (n, 3))
        acceleration += self._rng.normal(0.0, s.acceleration_noise, (n, 3))
        return _stepped(gyro, s.gyro_step), _stepped(acceleration, s.acceleration_step)


def _stepped(values: FloatArray, step: float) -> FloatArray:
    return np.round(values / step) * step if step > 0.0 else values
