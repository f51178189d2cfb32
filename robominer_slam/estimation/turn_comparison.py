"""Screws against gyro: the angle that both say the body has turned by, window by window.

Slip takes a share of what the screws turn, so on straight drives, where there is nothing to take a share of, they show
the gyro's bias; screws that stand show it best.

What the gyro says is the filter's own heading, less that at the window's start, which is a state (a clone: Roumeliotis
and Burdick, "Stochastic cloning", 2002): the gyro's noise is in the heading's covariance already. As noise of a
measurement of the bias alone it would count twice, and the covariance of the heading be far too large.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.estimation.planar_motion import KEY_YAW, SLIP, SLIP_MEAN, WINDOW_YAW, WZ, YAW

FloatArray = NDArray[np.float64]

#: Length of a window, s: one update of the filter for ten readings.
WINDOW_S = 0.2
#: More slip than this is a robot that is stuck: the model ends there.
MAX_SLIP = 0.9
SLIP_MEAN_TURN, SLIP_TURN = SLIP_MEAN.stop - 1, SLIP.stop - 1


def turned(state: FloatArray) -> float:
    """Angle that the body has turned by since the window's start, rad."""
    return float(state[KEY_YAW] + state[YAW] - state[WINDOW_YAW])


def turned_jacobian(state: FloatArray) -> FloatArray:
    """Derivative of `turned` by the state, shape (1, n)."""
    H = np.zeros((1, len(state)))
    H[0, KEY_YAW] = H[0, YAW] = 1.0
    H[0, WINDOW_YAW] = -1.0
    return H


def screw_turn(state: FloatArray) -> FloatArray:
    """Angle by which the screws seem to turn the body in the window, rad, shape (1,)."""
    grip = max(1.0 - state[SLIP_MEAN_TURN] - state[SLIP_TURN], 1.0 - MAX_SLIP)
    return np.array([turned(state) / grip])


def screw_turn_jacobian(state: FloatArray) -> FloatArray:
    """Derivative of `screw_turn` by the state, shape (1, n)."""
    grip = max(1.0 - state[SLIP_MEAN_TURN] - state[SLIP_TURN], 1.0 - MAX_SLIP)
    H: FloatArray = turned_jacobian(state) / grip
    H[0, SLIP_MEAN_TURN] = H[0, SLIP_TURN] = turned(state) / grip**2
    return H


class TurnComparison:
    """Sums what the screws turn; every window gives a measurement.

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
        self._screws = self._span = 0.0
        self._readings, self._still = 0, True

    @property
    def begins(self) -> bool:
        """Whether nothing is in the window yet."""
        return self._span == 0.0

    def add_gyro(self, dt: float) -> None:
        """The gyro has turned the filter's heading for `dt` seconds."""
        self._span += dt

    def add_screws(self, angle: float, still: bool, readings: int = 1) -> bool:
        """The screws say `angle`, rad, in their last readings; True once a window is full."""
        self._screws += angle
        self._readings += readings
        self._still = self._still and still
        return self._span >= WINDOW_S

    def measurement(self, state: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Innovation (1,), its derivative by the state (1, n) and its covariance (1, 1)."""
        span = self._span
        if self._still:
            R = (self._sigma_still * span) ** 2
            return np.array([-turned(state)]), turned_jacobian(state), np.array([[R]])
        R = self._screw_variance * span**2 / self._readings
        return self._screws - screw_turn(state), screw_turn_jacobian(state), np.array([[R]])

    def screws_alone(
        self, state: FloatArray, rate: float, still: bool, settings: RobustEstimationSection
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As `measurement`, of the turn rate itself: what a reading of the screws says while there is no gyro."""
        H = np.zeros((1, len(state)))
        H[0, WZ] = 1.0
        slip = (settings.sigma_slip**2 + settings.sigma_slip_mean**2) * rate**2
        R = self._sigma_still**2 if still else self._screw_variance + slip
        return np.array([(1.0 - settings.slip_mean) * rate - state[WZ]]), H, np.array([[R]])
