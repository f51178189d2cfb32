"""The robust filter's state and how it moves: pose since the last keyframe, body velocity, keyframe's pose, the rest.

State x = (x, y, yaw | vx, vy, wz | X, Y, YAW | slow states): pose of the levelled base_link in the levelled frame of
the last keyframe, body velocity, that keyframe's pose in odom, and what the source of motion needs (biases, slip).
Without a gyro the velocity is a random walk in all three axes; with one, the turn rate is its reading less the bias,
an input. Levelled: turned about a horizontal axis until z points up; a tilted body's velocity counts by its
horizontal part, u = level (vx, vy).
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

X, Y, YAW, VX, VY, WZ, KEY_X, KEY_Y, KEY_YAW, SLOW = range(10)
LEVEL = np.eye(2)
REL, VELOCITY, KEY = slice(X, VX), slice(VX, KEY_X), slice(KEY_X, SLOW)
#: Where the gyro's bias stands, if there is a gyro.
GYRO_BIAS = SLOW


def motion(state: FloatArray, dt: float, gyro: float | None = None, level: FloatArray = LEVEL) -> FloatArray:
    """The state `dt` seconds later at constant body velocity; midpoint in the heading.

    Args:
        state: shape (n,).
        dt: s.
        gyro: mean reading of the vertical gyro in the interval, rad/s; None without one.
        level: from body velocity (vx, vy) to its horizontal part ahead and to the left, shape (2, 2).
    """
    later = state.copy()
    if gyro is not None:
        later[WZ] = gyro - state[GYRO_BIAS]
    turn = later[WZ] * dt
    c, s = math.cos(state[YAW] + 0.5 * turn) * dt, math.sin(state[YAW] + 0.5 * turn) * dt
    ahead, left = level @ state[VX:WZ]
    later[X] += c * ahead - s * left
    later[Y] += s * ahead + c * left
    later[YAW] += turn
    return later


def motion_jacobian(state: FloatArray, dt: float, gyro: float | None = None, level: FloatArray = LEVEL) -> FloatArray:
    """Derivative of `motion` by the state, shape (n, n)."""
    F = np.eye(len(state))
    rate = state[WZ] if gyro is None else gyro - state[GYRO_BIAS]
    heading = state[YAW] + 0.5 * rate * dt
    c, s = math.cos(heading) * dt, math.sin(heading) * dt
    ahead, left = level @ state[VX:WZ]
    dx, dy = -s * ahead - c * left, c * ahead - s * left
    F[X, YAW], F[Y, YAW] = dx, dy
    (a, b), (d, e) = level
    F[X, VX], F[X, VY] = c * a - s * d, c * b - s * e
    F[Y, VX], F[Y, VY] = s * a + c * d, s * b + c * e
    turning = WZ if gyro is None else GYRO_BIAS
    sign = 1.0 if gyro is None else -1.0
    F[X, turning], F[Y, turning], F[YAW, turning] = sign * 0.5 * dt * dx, sign * 0.5 * dt * dy, sign * dt
    if gyro is not None:
        F[WZ, WZ], F[WZ, GYRO_BIAS] = 0.0, -1.0
    return F


def compose(state: FloatArray) -> FloatArray:
    """Pose of the levelled base_link in odom (x, y, yaw), shape (3,): keyframe's pose times the pose since."""
    c, s = math.cos(state[KEY_YAW]), math.sin(state[KEY_YAW])
    x, y = state[X], state[Y]
    return np.array(
        [state[KEY_X] + c * x - s * y, state[KEY_Y] + s * x + c * y, state[KEY_YAW] + state[YAW]]
    )  # fmt: skip


def compose_jacobian(state: FloatArray) -> FloatArray:
    """Derivative of `compose` by the state, shape (3, n)."""
    J = np.zeros((3, len(state)))
    c, s = math.cos(state[KEY_YAW]), math.sin(state[KEY_YAW])
    x, y = state[X], state[Y]
    J[0, X], J[0, Y], J[1, X], J[1, Y] = c, -s, s, c
    J[0, KEY_X] = J[1, KEY_Y] = J[2, KEY_YAW] = J[2, YAW] = 1.0
    J[0, KEY_YAW], J[1, KEY_YAW] = -s * x - c * y, c * x - s * y
    return J


class PlanarFilter(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """filterpy's filter with our motion, and a gate that never shuts.

    A measurement whose squared Mahalanobis distance d2 exceeds the gate counts with its covariance grown by
    d2 / gate: an outlier's pull is bounded, and a filter that has gone wrong is still pulled back.

    Attributes:
        outliers: measurements beyond the gate.
    """

    def __init__(self, x: FloatArray, P: FloatArray, gate: float) -> None:
        """Start at state x with covariance P."""
        super().__init__(dim_x=len(x), dim_z=3)
        self.x: FloatArray = x
        self.P: FloatArray = P
        self.gate = gate
        self.outliers = 0
        self._dt = 0.0
        self._gyro: float | None = None
        self._level = LEVEL
        self._fading: tuple[slice, float] | None = None

    def predict_x(self, u: float = 0.0) -> None:  # noqa: ARG002 - filterpy's signature; there is no input
        """Move the state."""
        self.x = motion(self.x, self._dt, self._gyro, self._level)
        if self._fading is not None:
            self.x[self._fading[0]] *= self._fading[1]

    def move(
        self,
        dt: float,
        Q: FloatArray,
        gyro: float | None = None,
        level: FloatArray = LEVEL,
        fading: tuple[slice, float] | None = None,
    ) -> None:
        """Predict `dt` seconds ahead.

        Args:
            dt, gyro, level: as of `motion`.
            Q: the noise that the motion adds, shape (n, n).
            fading: states of a Gauss-Markov process, and by what factor they fade.
        """
        self._dt, self._gyro, self._level, self._fading = dt, gyro, level, fading
        self.F = motion_jacobian(self.x, dt, gyro, level)
        if fading is not None:
            which = np.arange(len(self.x))[fading[0]]
            self.F[which, which] = fading[1]
        self.Q = Q
        self.predict()

    def correct(self, innovation: FloatArray, H: FloatArray, R: FloatArray) -> float:
        """Update with a measurement that differs from its prediction by `innovation`, shape (m,).

        Args:
            innovation: measured less predicted.
            H: derivative of the prediction by the state, shape (m, n).
            R: covariance of the measurement, shape (m, m).

        Returns:
            The squared Mahalanobis distance.
        """
        S = H @ self.P @ H.T + R
        distance = float(innovation @ np.linalg.solve(S, innovation))
        if distance > self.gate:
            self.outliers += 1
            R = R * (distance / self.gate)
        self.update(innovation, lambda _: H, lambda _: np.zeros(len(innovation)), R)
        return distance

    def keyframe(self) -> None:
        """Make the present pose the keyframe's: the pose since becomes zero and is known."""
        T = np.eye(len(self.x))
        T[KEY] = compose_jacobian(self.x)
        T[REL] = 0.0
        self.x[KEY] = compose(self.x)
        self.x[REL] = 0.0
        self.P = T @ self.P @ T.T
