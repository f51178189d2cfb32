"""Dead reckoning from a ready-made odometry alone: its body velocity integrated in its own heading.

v_odom = R(theta_odom) v_body, the thesis's odometry model (section 3.4.3) with its rotation set right; over an
interval the motion is the exponential map of the mean twist.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import Measurement, OdometrySample
from robominer_slam.estimation.odometry_state import OdometryState

FloatArray = NDArray[np.float64]

#: Longer gaps are dropouts: the velocity before them says nothing about them.
MAX_INTERVAL_S = 0.5
#: Deviation per sample at 30 Hz that the covariance assumes, as the thesis's model: m/s, m/s, rad/s.
SIGMA_PER_SAMPLE = np.array([0.05, 0.05, 0.05])
#: Bias that the covariance allows for: 3 mm/s and 3 mrad/s.
SIGMA_BIAS = np.array([0.003, 0.003, 0.003])


class IntegratedOdometry:
    """Integrates OdometrySample; each is the mean over the interval that ends at its stamp."""

    def __init__(self) -> None:
        self._pose = np.zeros(3)
        self._velocity = np.zeros(3)
        self._stamp_ns: int | None = None
        self._covariance = np.zeros((3, 3))
        self._bias_effect = np.zeros((3, 3))
        self.gaps = 0

    def add(self, measurement: Measurement) -> None:
        """Take an odometry sample; others are ignored."""
        if not isinstance(measurement, OdometrySample):
            return
        previous, self._stamp_ns = self._stamp_ns, measurement.stamp_ns
        self._velocity = measurement.velocity
        if previous is None:
            return
        interval = (measurement.stamp_ns - previous) * 1e-9
        if interval <= 0.0:
            self._stamp_ns = previous
            return
        if interval > MAX_INTERVAL_S:
            self.gaps += 1
            return
        self._grow_covariance(interval)
        self._pose = advance(self._pose, self._velocity, interval)

    def measures_motion(self, measurement: Measurement) -> bool:
        """Only a ready-made odometry does here."""
        return isinstance(measurement, OdometrySample)

    def state_at(self, stamp_ns: int) -> OdometryState:
        """The pose carried on from the last sample with its velocity, without keeping that."""
        pose = self._pose
        if self._stamp_ns is not None:
            ahead = (stamp_ns - self._stamp_ns) * 1e-9
            if 0.0 < ahead <= MAX_INTERVAL_S:
                pose = advance(pose, self._velocity, ahead)
        bias = SIGMA_BIAS**2
        covariance = self._covariance + self._bias_effect @ np.diag(bias) @ self._bias_effect.T
        return OdometryState(
            stamp_ns,
            float(pose[0]),
            float(pose[1]),
            float(pose[2]),
            self._velocity.copy(),
            covariance,
            np.diag(SIGMA_PER_SAMPLE**2),
        )

    def _grow_covariance(self, interval: float) -> None:
        c, s = np.cos(self._pose[2]), np.sin(self._pose[2])
        vx, vy = self._velocity[0], self._velocity[1]
        F = np.eye(3)
        F[0, 2] = (-s * vx - c * vy) * interval
        F[1, 2] = (c * vx - s * vy) * interval
        G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) * interval
        self._covariance = F @ self._covariance @ F.T + G @ np.diag(SIGMA_PER_SAMPLE**2) @ G.T
        # A constant bias adds up along the path, where white noise averages out.
        self._bias_effect = F @ self._bias_effect + G


def advance(pose: FloatArray, velocity: FloatArray, interval: float) -> FloatArray:
    """Pose (x, y, yaw) after `interval` seconds at a constant body velocity: the exponential map of SE(2)."""
    turn = velocity[2] * interval
    # sin(turn)/turn and (1 - cos(turn))/turn, smooth at zero.
    a = float(np.sinc(turn / np.pi))
    b = 0.5 * turn * float(np.sinc(turn / (2.0 * np.pi))) ** 2
    dx = (a * velocity[0] - b * velocity[1]) * interval
    dy = (b * velocity[0] + a * velocity[1]) * interval
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, pose[2] + turn])
