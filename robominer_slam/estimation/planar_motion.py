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
from array import array
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from robominer_slam.float_array import of_floats

FloatArray = NDArray[np.float64]

X, Y, YAW, VX, VY, WZ, KEY_X, KEY_Y, KEY_YAW, SLOW = range(10)
LEVEL = ((1.0, 0.0), (0.0, 1.0))
Pose: TypeAlias = tuple[float, float, float]
REL, VELOCITY, KEY = slice(X, VX), slice(VX, KEY_X), slice(KEY_X, SLOW)
#: Slow states with gyro and screws: bias of the gyro, slip (mean and varying part) of vx, vy, wz.
GYRO_BIAS, SLIP_MEAN, SLIP = SLOW, slice(SLOW + 1, SLOW + 4), slice(SLOW + 4, SLOW + 7)
#: Last of the slow states with gyro and screws: heading in odom at the start of a window, see `turn_comparison`.
WINDOW_YAW = SLIP.stop


class Inputs(NamedTuple):
    """What moves the state in an interval.

    Attributes:
        dt: length of the interval, s.
        gyro: mean reading of the vertical gyro, rad/s; None: the turn rate walks.
        screws: vx, vy of the screws without slip, shape (2,), m/s; None: the velocity walks.
        level: from body velocity (vx, vy) to its horizontal part ahead and to the left, row by row.
    """

    dt: float
    gyro: float | None = None
    screws: FloatArray | None = None
    level: tuple[tuple[float, float], tuple[float, float]] = LEVEL


class MotionNoise(NamedTuple):
    """Covariance of what moves the state in an interval: xx, xy, yy of vx and vy, of wz, and of x and y beside them."""

    xx: float
    xy: float
    yy: float
    turn: float
    position: float


class Step(NamedTuple):
    """An interval's motion: the state after it, and derivatives of what moves, X to WZ (the other states stay).

    Attributes:
        state: after the interval, shape (n,).
        by_state: derivative of the moving states by the state before, shape (6, n).
        pose_by_velocity: derivative of x and y by the velocity in the interval, row by row; that of yaw by the turn
            rate is dt, and the velocity is itself.
        dt: length of the interval, s.
    """

    state: FloatArray
    by_state: FloatArray
    pose_by_velocity: tuple[float, float, float, float, float, float]
    dt: float

    def covariance(self, noise: MotionNoise) -> FloatArray:
        """What noise adds to the covariance of the moving states, shape (6, 6): G Q G' with G their derivative by it.

        In plain floats, as `step`.
        """
        xx, xy, xw, yx, yy, yw = self.pose_by_velocity
        dt, q_xy, q_w = self.dt, noise.xy, noise.turn
        # Covariances of x, y and yaw with the velocity: G Q, whose last rows are Q.
        ax, bx, cx = xx * noise.xx + xy * q_xy, xx * q_xy + xy * noise.yy, xw * q_w
        ay, by, cy = yx * noise.xx + yy * q_xy, yx * q_xy + yy * noise.yy, yw * q_w
        turned = dt * q_w
        across = ax * yx + bx * yy + cx * yw
        rows = [
            *(ax * xx + bx * xy + cx * xw + noise.position, across, cx * dt, ax, bx, cx),
            *(across, ay * yx + by * yy + cy * yw + noise.position, cy * dt, ay, by, cy),
            *(cx * dt, cy * dt, turned * dt, 0.0, 0.0, turned),
            *(ax, ay, 0.0, noise.xx, q_xy, 0.0),
            *(bx, by, 0.0, q_xy, noise.yy, 0.0),
            *(cx, cy, turned, 0.0, 0.0, q_w),
        ]
        return of_floats(rows).reshape(6, 6)


def step(state: FloatArray, inputs: Inputs) -> Step:
    """Move for an interval at constant body velocity; midpoint in the heading.

    In plain floats: numpy takes longer to hand out a number than it takes to compute with it.
    """
    values = state.tolist()
    n = len(values)
    vx, vy, wz = values[VELOCITY]
    # Derivatives of the velocity by the state: column, and what each row has there.
    by_vx: tuple[int, ...] = (VX,)
    by_vy: tuple[int, ...] = (VY,)
    by_wz = WZ
    slope_x = slope_y = slope_wz = 1.0
    if inputs.screws is not None:
        screw_x, screw_y = inputs.screws.tolist()
        mean, varying = SLIP_MEAN.start, SLIP.start
        vx = screw_x * (1.0 - values[mean] - values[varying])
        vy = screw_y * (1.0 - values[mean + 1] - values[varying + 1])
        by_vx, by_vy = (mean, varying), (mean + 1, varying + 1)
        slope_x, slope_y = -screw_x, -screw_y
    if inputs.gyro is not None:
        wz = inputs.gyro - values[GYRO_BIAS]
        by_wz, slope_wz = GYRO_BIAS, -1.0
    dt = inputs.dt
    middle = values[YAW] + 0.5 * wz * dt
    c, s = math.cos(middle) * dt, math.sin(middle) * dt
    (a, b), (d, e) = inputs.level
    ahead, left = a * vx + b * vy, d * vx + e * vy
    dx, dy = c * ahead - s * left, s * ahead + c * left
    values[X] += dx
    values[Y] += dy
    values[YAW] += wz * dt
    values[VELOCITY] = vx, vy, wz
    xx, xy = c * a - s * d, c * b - s * e
    yx, yy = s * a + c * d, s * b + c * e
    xw, yw = -0.5 * dt * dy, 0.5 * dt * dx
    # The six rows one after the other: row k begins at k n. Most of them are zeros, which need not be handed over.
    F = array("d", bytes(8 * 6 * n))
    F[X] = F[n + Y] = F[2 * n + YAW] = 1.0
    F[YAW], F[n + YAW] = -dy, dx
    for column in by_vx:
        F[column] += xx * slope_x
        F[n + column] += yx * slope_x
        F[VX * n + column] = slope_x
    for column in by_vy:
        F[column] += xy * slope_y
        F[n + column] += yy * slope_y
        F[VY * n + column] = slope_y
    F[by_wz] += xw * slope_wz
    F[n + by_wz] += yw * slope_wz
    F[2 * n + by_wz] += dt * slope_wz
    F[WZ * n + by_wz] = slope_wz
    return Step(of_floats(values), np.frombuffer(F).reshape(6, n), (xx, xy, xw, yx, yy, yw), dt)


def compose(state: FloatArray) -> Pose:
    """Pose of the levelled base_link in odom (x, y, yaw): keyframe's pose times the pose since."""
    x, y, yaw, _, _, _, key_x, key_y, key_yaw, *_ = state.tolist()
    c, s = math.cos(key_yaw), math.sin(key_yaw)
    return key_x + c * x - s * y, key_y + s * x + c * y, key_yaw + yaw


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
    n = len(state)
    # The three rows one after the other.
    J = array("d", bytes(8 * 3 * n))
    x, y, _, _, _, _, _, _, key_yaw, *_ = state.tolist()
    c, s = math.cos(key_yaw), math.sin(key_yaw)
    J[X], J[Y], J[n + X], J[n + Y] = c, -s, s, c
    J[KEY_X] = J[n + KEY_Y] = J[2 * n + KEY_YAW] = J[2 * n + YAW] = 1.0
    J[KEY_YAW], J[n + KEY_YAW] = -s * x - c * y, c * x - s * y
    return np.frombuffer(J).reshape(3, n)


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
