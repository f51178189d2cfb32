"""The robust filter's state and how it moves: pose since the last keyframe, body velocity, keyframe's pose, the rest.

State x = (x, y, yaw | vx, vy, wz | X, Y, YAW | slow states): pose of the levelled base_link in the levelled frame of
the last keyframe, body velocity, that keyframe's pose in odom, and what the source of motion needs (biases, slip).
Levelled: turned about a horizontal axis until z points up; a tilted body's velocity counts by its horizontal part.

Velocities are random walks unless they are inputs: the turn rate is then the gyro's reading less its bias, the
velocity what the screws would give without slip, times 1 - slip. As inputs, because a filter that weighs a
measurement v / (1 - slip) against a walk of v reads slip out of every acceleration, where there is nothing to read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

X, Y, YAW, VX, VY, WZ, KEY_X, KEY_Y, KEY_YAW, SLOW = range(10)
LEVEL = np.eye(2)
REL, VELOCITY, KEY = slice(X, VX), slice(VX, KEY_X), slice(KEY_X, SLOW)
#: Slow states with gyro and screws: bias of the gyro, slip (mean and varying part) of vx, vy, wz.
GYRO_BIAS, SLIP_MEAN, SLIP = SLOW, slice(SLOW + 1, SLOW + 4), slice(SLOW + 4, SLOW + 7)
#: Last of the slow states with gyro and screws: heading in odom at the start of a window, see `turn_comparison`.
WINDOW_YAW = SLIP.stop


@dataclass(frozen=True, slots=True)
class Inputs:
    """What moves the state in an interval.

    Attributes:
        dt: length of the interval, s.
        gyro: mean reading of the vertical gyro, rad/s; None: the turn rate walks.
        screws: vx, vy of the screws without slip, shape (2,), m/s; None: the velocity walks.
        level: from body velocity (vx, vy) to its horizontal part ahead and to the left, shape (2, 2).
    """

    dt: float
    gyro: float | None = None
    screws: FloatArray | None = None
    level: FloatArray = field(default_factory=lambda: LEVEL)


def velocity(state: FloatArray, inputs: Inputs) -> tuple[float, float, float]:
    """Body velocity vx, vy, wz in the interval."""
    # Plain floats: numpy takes longer to hand out a number than it takes to compute with it.
    values = state.tolist()
    vx, vy, wz = values[VELOCITY]
    if inputs.screws is not None:
        vx, vy = inputs.screws.tolist()
        mean, varying = SLIP_MEAN.start, SLIP.start
        vx *= 1.0 - values[mean] - values[varying]
        vy *= 1.0 - values[mean + 1] - values[varying + 1]
    if inputs.gyro is not None:
        wz = inputs.gyro - values[GYRO_BIAS]
    return vx, vy, wz


def velocity_jacobian(state: FloatArray, inputs: Inputs) -> FloatArray:
    """Derivative of `velocity` by the state, shape (3, n)."""
    V = np.zeros((3, len(state)))
    if inputs.screws is None:
        V[0, VX] = V[1, VY] = 1.0
    else:
        V[0, SLIP_MEAN.start] = V[0, SLIP.start] = -inputs.screws[0]
        V[1, SLIP_MEAN.start + 1] = V[1, SLIP.start + 1] = -inputs.screws[1]
    if inputs.gyro is None:
        V[2, WZ] = 1.0
    else:
        V[2, GYRO_BIAS] = -1.0
    return V


def motion(state: FloatArray, inputs: Inputs) -> FloatArray:
    """The state after an interval at constant body velocity; midpoint in the heading."""
    later = state.copy()
    vx, vy, wz = velocity(state, inputs)
    later[VELOCITY] = vx, vy, wz
    dt = inputs.dt
    turn = wz * dt
    middle = float(state[YAW]) + 0.5 * turn
    c, s = math.cos(middle) * dt, math.sin(middle) * dt
    (a, b), (d, e) = inputs.level.tolist()
    ahead, left = a * vx + b * vy, d * vx + e * vy
    later[X] += c * ahead - s * left
    later[Y] += s * ahead + c * left
    later[YAW] += turn
    return later


def motion_jacobian(state: FloatArray, inputs: Inputs) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `motion` by the state, (n, n), and of the pose (x, y, yaw) by the velocity, (3, 3)."""
    vx, vy, wz = velocity(state, inputs)
    dt = inputs.dt
    heading = float(state[YAW]) + 0.5 * wz * dt
    c, s = math.cos(heading) * dt, math.sin(heading) * dt
    (a, b), (d, e) = inputs.level.tolist()
    ahead, left = a * vx + b * vy, d * vx + e * vy
    dx, dy = -s * ahead - c * left, c * ahead - s * left
    D = np.array(
        [
            [c * a - s * d, c * b - s * e, 0.5 * dt * dx],
            [s * a + c * d, s * b + c * e, 0.5 * dt * dy],
            [0.0, 0.0, dt],
        ]
    )
    V = velocity_jacobian(state, inputs)
    F = _identity(len(state)).copy()
    F[VELOCITY] = V
    F[REL] += D.dot(V)
    F[X, YAW], F[Y, YAW] = dx, dy
    return F, D


@cache
def _identity(n: int) -> FloatArray:
    return np.eye(n)


def compose(state: FloatArray) -> FloatArray:
    """Pose of the levelled base_link in odom (x, y, yaw), shape (3,): keyframe's pose times the pose since."""
    x, y, yaw, _, _, _, key_x, key_y, key_yaw, *_ = state.tolist()
    c, s = math.cos(key_yaw), math.sin(key_yaw)
    return np.array([key_x + c * x - s * y, key_y + s * x + c * y, key_yaw + yaw])


def given_bias(state: FloatArray, P: FloatArray, bias: slice) -> tuple[FloatArray, FloatArray]:
    """Of the pose since the last keyframe, in its own frame: covariance if the biases were known, slope by them.

    Shapes (3, 3) and (3, nb).
    """
    c, s = math.cos(state[YAW]), math.sin(state[YAW])
    to_new = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    P_bias = P[bias, bias]
    by_bias = np.linalg.solve(P_bias + 1e-18 * np.eye(len(P_bias)), P[bias, REL]).T
    conditional = P[REL, REL] - by_bias @ P[bias, REL]
    return to_new @ conditional @ to_new.T, to_new @ by_bias


def compose_jacobian(state: FloatArray) -> FloatArray:
    """Derivative of `compose` by the state, shape (3, n)."""
    J = np.zeros((3, len(state)))
    x, y, _, _, _, _, _, _, key_yaw, *_ = state.tolist()
    c, s = math.cos(key_yaw), math.sin(key_yaw)
    J[0, X], J[0, Y], J[1, X], J[1, Y] = c, -s, s, c
    J[0, KEY_X] = J[1, KEY_Y] = J[2, KEY_YAW] = J[2, YAW] = 1.0
    J[0, KEY_YAW], J[1, KEY_YAW] = -s * x - c * y, c * x - s * y
    return J


def motion_ahead(state: FloatArray, ahead: FloatArray, screws: FloatArray | None) -> FloatArray:
    """Orthonormal combinations of states that are motion ahead, shape (k, n): the drag's angle must not move them.

    Its derivative by them is zero but for noise in the direction, which repeated updates would take for knowledge of
    the speed.

    Args:
        state: shape (n,).
        ahead: direction of motion in base_link, unit vector, shape (2,).
        screws: vx, vy of the screws without slip; None where the slow states are biases of vx, vy, wz.
    """
    c, s = math.cos(state[YAW]), math.sin(state[YAW])
    held = np.zeros((3 if screws is None else 4, len(state)))
    held[0, VX:WZ] = ahead
    held[1, X:YAW] = c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]
    if screws is None:
        held[2, SLOW : SLOW + 2] = ahead
        return held
    by_slip = ahead * screws
    by_slip = by_slip / max(math.hypot(by_slip[0], by_slip[1]), 1e-9)
    held[2, SLIP_MEAN.start : SLIP_MEAN.start + 2] = by_slip
    held[3, SLIP.start : SLIP.start + 2] = by_slip
    return held


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
        self._inputs = Inputs(0.0)
        self._fading = 1.0
        self._effect = np.vstack([np.zeros((3, 3)), np.eye(3)])

    def predict_x(self, _u: float = 0.0) -> None:
        """Move the state."""
        self.x = motion(self.x, self._inputs)
        if self._fading < 1.0:
            self.x[SLIP] *= self._fading

    def move(self, inputs: Inputs, Q_velocity: FloatArray, q: FloatArray, fading: float = 1.0) -> None:
        """Predict to the end of an interval.

        Args:
            inputs: what moves the state.
            Q_velocity: covariance of the velocity in the interval, shape (3, 3).
            q: variances that the interval adds to the states, shape (n,).
            fading: factor by which the varying slip fades.
        """
        self._inputs, self._fading = inputs, fading
        F, D = motion_jacobian(self.x, inputs)
        n = len(q)
        Q = np.zeros((n, n))
        Q.reshape(-1)[:: n + 1] = q
        # What the velocity's noise does to the pose and to the velocity itself; `dot` takes half of what `@` does.
        effect = self._effect
        effect[REL] = D
        Q[:KEY_X, :KEY_X] += effect.dot(Q_velocity).dot(effect.T)
        if fading < 1.0:
            F[SLIP, SLIP] *= fading
        self.F, self.Q = F, Q
        self.predict()

    def correct(self, innovation: FloatArray, H: FloatArray, R: FloatArray, held: FloatArray | None = None) -> float:
        """Update with a measurement that differs from its prediction by `innovation`, shape (m,).

        Args:
            innovation: measured less predicted.
            H: derivative of the prediction by the state, shape (m, n).
            R: covariance of the measurement, shape (m, m).
            held: orthonormal rows, shape (k, n): combinations of states that this measurement must not move.

        Returns:
            The squared Mahalanobis distance.
        """
        PHT = self.P @ H.T
        S = H @ PHT + R
        if len(innovation) == 1:
            distance = float(innovation[0] ** 2 / S[0, 0])
        else:
            distance = float(innovation @ np.linalg.solve(S, innovation))
        if distance > self.gate:
            self.outliers += 1
            R = R * (distance / self.gate)
        if held is None:
            self.update(innovation, lambda _: H, lambda _: np.zeros(len(innovation)), R)
            return distance
        # Any gain is allowed as long as the covariance follows it (Joseph's form); this one leaves `held` alone.
        gain = np.linalg.solve(H @ PHT + R, PHT.T).T
        gain -= held.T @ (held @ gain)
        left = np.eye(len(self.x)) - gain @ H
        self.x = self.x + gain @ innovation
        self.P = left @ self.P @ left.T + gain @ R @ gain.T
        return distance

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
