"""The robust filter: the planar state moved through intervals, from keyframe to keyframe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.estimation.kalman_filter import KalmanFilter
from robominer_slam.estimation.planar_motion import (
    KEY,
    KEY_X,
    KEY_YAW,
    REL,
    SLIP,
    WINDOW_YAW,
    YAW,
    Inputs,
    compose,
    compose_jacobian,
    step,
)
from robominer_slam.float_array import of_floats

FloatArray = NDArray[np.float64]


class PlanarFilter(KalmanFilter):
    """State of `planar_motion`."""

    def move(self, inputs: Inputs, Q_velocity: FloatArray, q: list[float], fading: float = 1.0) -> None:
        """Predict to the end of an interval.

        Args:
            inputs: what moves the state.
            Q_velocity: covariance of the velocity in the interval, shape (3, 3).
            q: variances that the interval adds to the states, n of them.
            fading: factor by which the varying slip fades.
        """
        moved = step(self.x, inputs)
        x, F, P = moved.state, moved.by_state, self.P
        # P = F P F' + Q, where all rows of F but the first six are the unit matrix's: a third of the products.
        rows = F.dot(P)
        corner = rows.dot(F.T)
        corner += moved.by_velocity.dot(Q_velocity).dot(moved.by_velocity.T)
        later = P.copy()
        later[:KEY_X] = rows
        later[KEY_X:, :KEY_X] = rows[:, KEY_X:].T
        later[:KEY_X, :KEY_X] = corner
        if fading < 1.0:
            fade = np.ones(len(x))
            fade[SLIP] = fading
            x *= fade
            later *= fade
            later *= fade[:, None]
        later.reshape(-1)[:: len(q) + 1] += of_floats(q)
        self.x, self.P = x, later

    def begin_window(self) -> None:
        """Keep the present heading in odom as the window's."""
        T = np.eye(len(self.x))
        T[WINDOW_YAW] = 0.0
        T[WINDOW_YAW, [YAW, KEY_YAW]] = 1.0
        self.x = T @ self.x
        self.P = T @ self.P @ T.T

    def keyframe(self) -> None:
        """Make the present pose the keyframe's: the pose since becomes zero and is known."""
        T = np.eye(len(self.x))
        T[KEY] = compose_jacobian(self.x)
        T[REL] = 0.0
        self.x[KEY] = compose(self.x)
        self.x[REL] = 0.0
        self.P = T @ self.P @ T.T
