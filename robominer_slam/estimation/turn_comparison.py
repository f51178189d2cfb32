"""Screws against gyro: the angle that both say the body has turned by, window by window.

Slip takes a share of what the screws turn, so on straight drives, where there is nothing to take a share of, they show
the gyro's bias; screws that stand show it best.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.estimation.planar_motion import GYRO_BIAS, SLIP, SLIP_MEAN

FloatArray = NDArray[np.float64]

#: Length of a window, s: one update of the filter for ten readings.
WINDOW_S = 0.2
#: More slip than this is a robot that is stuck: the model ends there.
MAX_SLIP = 0.9
SLIP_MEAN_TURN, SLIP_TURN = SLIP_MEAN.stop - 1, SLIP.stop - 1


def screw_turn(state: FloatArray, gyro_angle: float, span: float) -> FloatArray:
    """Angle by which the screws seem to turn the body while the gyro reads `gyro_angle`, rad, shape (1,)."""
    grip = max(1.0 - state[SLIP_MEAN_TURN] - state[SLIP_TURN], 1.0 - MAX_SLIP)
    return np.array([(gyro_angle - state[GYRO_BIAS] * span) / grip])


def screw_turn_jacobian(state: FloatArray, gyro_angle: float, span: float) -> FloatArray:
    """Derivative of `screw_turn` by the state, shape (1, n)."""
    grip = max(1.0 - state[SLIP_MEAN_TURN] - state[SLIP_TURN], 1.0 - MAX_SLIP)
    H = np.zeros((1, len(state)))
    H[0, GYRO_BIAS] = -span / grip
    H[0, SLIP_MEAN_TURN] = H[0, SLIP_TURN] = (gyro_angle - state[GYRO_BIAS] * span) / grip**2
    return H


class TurnComparison:
    """Sums both angles; every window gives a measurement.

    Args:
        sigma_still: creep of a robot whose screws stand, rad/s.
        screw_variance: of the screws' turn rate per reading, rad2/s2.
    """

    def __init__(self, sigma_still: float, screw_variance: float) -> None:
        self._sigma_still = sigma_still
        self._screw_variance = screw_variance
        self.running = False
        self.start()

    def start(self, running: bool = False) -> None:
        """Begin a window, or wait for one."""
        self.running = running
        self._gyro = self._screws = self._span = self._variance = 0.0
        self._readings, self._still = 0, True

    def add_gyro(self, angle: float, variance: float, dt: float) -> None:
        """The gyro has read `angle`, rad, of `variance`, rad2, in `dt` seconds."""
        self._gyro += angle
        self._variance += variance
        self._span += dt

    def add_screws(self, angle: float, still: bool) -> bool:
        """The screws say `angle`, rad, since their last reading; True once a window is full."""
        self._screws += angle
        self._readings += 1
        self._still = self._still and still
        return self._span >= WINDOW_S

    def measurement(self, state: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Innovation (1,), its derivative by the state (1, n) and its covariance (1, 1)."""
        span = self._span
        if self._still:
            H = np.zeros((1, len(state)))
            H[0, GYRO_BIAS] = span
            R = self._variance + (self._sigma_still * span) ** 2
            return np.array([self._gyro - state[GYRO_BIAS] * span]), H, np.array([[R]])
        R = self._variance + self._screw_variance * span**2 / self._readings
        innovation = self._screws - screw_turn(state, self._gyro, span)
        return innovation, screw_turn_jacobian(state, self._gyro, span), np.array([[R]])
