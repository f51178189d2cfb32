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
    MotionNoise,
    compose,
    compose_jacobian,
    step,
)
from robominer_slam.float_array import of_floats

FloatArray = NDArray[np.float64]


class PlanarFilter(KalmanFilter):
    """State of `planar_motion`."""

    def move(self, inputs: Inputs, noise: MotionNoise) -> None:
        """Predict to the end of an interval."""
        moved = step(self.x, inputs)
        x, F, P = moved.state, moved.by_state, self.P
        # P = F P F' + Q, where all rows of F but the first six are the unit matrix's: a third of the products.
        rows = F.dot(P)
        corner = rows.dot(F.T)
        corner += moved.covariance(noise)
        later = P.copy()
        later[:KEY_X] = rows
        later[KEY_X:, :KEY_X] = rows[:, KEY_X:].T
        later[:KEY_X, :KEY_X] = corner
        self.x, self.P = x, later

    def walk(self, q: list[float], fading: float = 1.0) -> None:
        """Let states walk by the variances q, n of them, after the varying slip has faded by a factor."""
        x, P = self.x, self.P
        if fading < 1.0:
            fade = np.ones(len(x))
            fade[SLIP] = fading
            x, P = x * fade, P * fade
            P *= fade[:, None]
        else:
            P = P.copy()
        P.reshape(-1)[:: len(q) + 1] += of_floats(q)
        self.x, self.P = x, P

    def begin_window(self) -> None:
        """Keep the present heading in odom as the window's."""
        x, P = self.x.copy(), self.P.copy()
        x[WINDOW_YAW] = x[YAW] + x[KEY_YAW]
        # T P T' with a T that puts the sum of two rows in the place of a third.
        P[WINDOW_YAW] = P[YAW] + P[KEY_YAW]
        P[:, WINDOW_YAW] = P[:, YAW] + P[:, KEY_YAW]
        self.x, self.P = x, P

    def keyframe(self) -> None:
        """Make the present pose the keyframe's: the pose since becomes zero and is known."""
        T = np.eye(len(self.x))
        T[KEY] = compose_jacobian(self.x)
        T[REL] = 0.0
        self.x[KEY] = compose(self.x)
        self.x[REL] = 0.0
        self.P = T @ self.P @ T.T
