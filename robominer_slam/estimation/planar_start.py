"""The robust filter's state at the start: what each source of motion needs, and how well it is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.estimation.planar_motion import GYRO_BIAS, SLIP, SLIP_MEAN, SLOW, VELOCITY, WINDOW_YAW

FloatArray = NDArray[np.float64]

#: Slow states with a ready-made odometry: its biases of vx, vy, wz.
ODOMETRY_BIAS = slice(SLOW, SLOW + 3)
#: The last states, with either source: what scan matches have in common, see `scan_match`.
MATCH_STATES = 3
#: Velocity at the start may be anything a robot does, m/s and rad/s.
SIGMA_START = 0.01


def fused(settings: RobustEstimationSection) -> tuple[FloatArray, FloatArray]:
    """State and variances with gyro and screws, shape (n,) each."""
    x, variance = _start(settings, WINDOW_YAW + 1)
    variance[GYRO_BIAS] = settings.sigma_gyro_bias**2
    variance[SLIP_MEAN] = settings.sigma_slip_mean**2
    variance[SLIP] = settings.sigma_slip**2
    x[SLIP_MEAN] = settings.slip_mean
    return x, variance


def odometry(settings: RobustEstimationSection) -> tuple[FloatArray, FloatArray]:
    """State and variances with a ready-made odometry, shape (n,) each."""
    x, variance = _start(settings, ODOMETRY_BIAS.stop)
    variance[ODOMETRY_BIAS] = settings.sigma_odometry_bias**2
    return x, variance


def odometry_rows() -> FloatArray:
    """Derivative by the state of what a ready-made odometry measures, velocity and bias, shape (3, n)."""
    H = np.zeros((3, ODOMETRY_BIAS.stop + MATCH_STATES))
    H[:, VELOCITY] = H[:, ODOMETRY_BIAS] = np.eye(3)
    return H


def _start(settings: RobustEstimationSection, matches: int) -> tuple[FloatArray, FloatArray]:
    n = matches + MATCH_STATES
    variance = np.zeros(n)
    variance[VELOCITY] = SIGMA_START**2
    variance[matches:] = np.square(
        [settings.sigma_match, settings.sigma_match, np.deg2rad(settings.sigma_match_yaw_deg)]
    )
    return np.zeros(n), variance
