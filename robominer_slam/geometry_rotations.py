"""Rotations in space: quaternions x y z w, matrices, rotation vectors, roll-pitch-yaw, and SO(3)'s Jacobians.

Vectorised over leading axes. Import these from `robominer_slam.geometry`, which states the conventions.

Sources: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018); Shepperd,
"Quaternion from rotation matrix" (1978).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

# 1 - (x/2) cot(x/2) = sum of |B_2n| x^2n / (2n)!, Bernoulli's numbers; n = 1 ... 8, converges for |x| < 2 pi.
_COT_SERIES = (
    1.0 / 12.0,
    1.0 / 720.0,
    1.0 / 30240.0,
    1.0 / 1209600.0,
    1.0 / 47900160.0,
    691.0 / 1307674368000.0,
    1.0 / 74724249600.0,
    3617.0 / 10670622842880000.0,
)
_COT_SLOPE_SERIES = tuple(2.0 * (k + 1) * b for k, b in enumerate(_COT_SERIES[1:]))
# (x - sin x) / x^3 = sum of (-1)^n x^2n / (2n + 3)!
_SINE_SERIES = (1.0 / 6.0, -1.0 / 120.0, 1.0 / 5040.0, -1.0 / 362880.0, 1.0 / 39916800.0, -1.0 / 6227020800.0)
# Below this squared angle (0.5 rad) the series are exact to rounding; above it the closed forms are.
_SERIES_BELOW = 0.25


def _series(x2: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    total = coefficients[-1] * x2
    for coefficient in coefficients[-2:0:-1]:
        total += coefficient
        total *= x2
    return total + coefficients[0]


def cot_coefficient(x2: FloatArray) -> FloatArray:
    """(1 - (x/2) cot(x/2)) / x^2 for x^2 < (2 pi)^2."""
    small = x2 < _SERIES_BELOW
    if np.count_nonzero(small) == small.size:
        return _series(x2, _COT_SERIES)
    safe = np.where(small, 1.0, x2)
    half = 0.5 * np.sqrt(safe)
    return np.where(small, _series(x2, _COT_SERIES), (1.0 - half * np.cos(half) / np.sin(half)) / safe)


def cot_coefficient_slope(x2: FloatArray, c: FloatArray) -> FloatArray:
    """Derivative of `cot_coefficient` by x, divided by x; `c` is the coefficient itself."""
    small = x2 < _SERIES_BELOW
    if np.count_nonzero(small) == small.size:
        return _series(x2, _COT_SLOPE_SERIES)
    safe = np.where(small, 1.0, x2)
    x = np.sqrt(safe)
    closed = ((1.0 - np.sinc(x / np.pi)) / (2.0 * (1.0 - np.cos(x))) - 2.0 * c) / safe
    return np.where(small, _series(x2, _COT_SLOPE_SERIES), closed)


def sine_coefficient(x2: FloatArray) -> FloatArray:
    """(x - sin x) / x^3."""
    small = x2 < _SERIES_BELOW
    if np.count_nonzero(small) == small.size:
        return _series(x2, _SINE_SERIES)
    safe = np.where(small, 1.0, x2)
    return np.where(small, _series(x2, _SINE_SERIES), (1.0 - np.sinc(np.sqrt(safe) / np.pi)) / safe)


def squared_norm(v: FloatArray) -> FloatArray:
    """Squared lengths (...,) of vectors (..., n)."""
    return np.asarray(np.einsum("...i,...i->...", v, v))


def wrap_angle(angle: ArrayLike | float) -> FloatArray:
    """Angle(s) in (-pi, pi], rad. Those already inside come back unchanged to the bit."""
    if isinstance(angle, float) and -math.pi < angle < math.pi:
        return np.asarray(angle, dtype=np.float64)
    a = np.asarray(angle, dtype=np.float64)
    if np.count_nonzero(np.abs(a) < np.pi) == a.size:
        return a.copy()
    wrapped = a - 2.0 * np.pi * np.rint(a / (2.0 * np.pi))
    return np.where(np.abs(wrapped) >= np.pi, np.pi, wrapped)


def hat(v: ArrayLike) -> FloatArray:
    """Cross-product matrices [v]x (..., 3, 3) of vectors (..., 3): times u they give v x u."""
    w = np.asarray(v, dtype=np.float64)
    out = np.zeros((*w.shape, 3))
    out[..., 2, 1] = w[..., 0]
    out[..., 0, 2] = w[..., 1]
    out[..., 1, 0] = w[..., 2]
    out[..., 1, 2] = -w[..., 0]
    out[..., 2, 0] = -w[..., 1]
    out[..., 0, 1] = -w[..., 2]
    return out


def quaternion_to_matrix(quaternion: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of quaternions x y z w (..., 4) of any length but zero.

    Raises:
        ValueError: a quaternion is zero or not finite.
    """
    q = np.asarray(quaternion, dtype=np.float64)
    norm = np.sqrt(squared_norm(q))
    if not (np.isfinite(norm) & (norm > 0.0)).all():
        raise ValueError("a quaternion is zero or not finite; expected x y z w of length 1")
    q = q / norm[..., None]
    v, w = q[..., :3], q[..., 3, None, None]
    cross = hat(v)
    return np.eye(3) + 2.0 * (w * cross + cross @ cross)


def matrix_to_quaternion(R: ArrayLike) -> FloatArray:
    """Quaternions x y z w (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    The columns of 4 q q' are linear in R; the longest one divided by its length is q (Shepperd 1978, without
    branches), which is well conditioned at any angle, pi included.
    """
    m = np.asarray(R, dtype=np.float64)
    if m.ndim == 2:
        return np.array(quaternion_of(*m.tolist()))
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    ww = 1.0 + xx + yy + zz
    if (ww > 2.0).all():  # angles below 90 degrees: the last column is the longest
        q = np.empty((*ww.shape, 4))
        q[..., 0] = m[..., 2, 1] - m[..., 1, 2]
        q[..., 1] = m[..., 0, 2] - m[..., 2, 0]
        q[..., 2] = m[..., 1, 0] - m[..., 0, 1]
        q[..., 3] = ww
        return np.asarray(q / np.sqrt(squared_norm(q))[..., None])
    K = np.empty((*m.shape[:-2], 4, 4))
    K[..., 0, 0] = 1.0 + xx - yy - zz
    K[..., 1, 1] = 1.0 - xx + yy - zz
    K[..., 2, 2] = 1.0 - xx - yy + zz
    K[..., 3, 3] = ww
    K[..., 0, 1] = K[..., 1, 0] = m[..., 1, 0] + m[..., 0, 1]
    K[..., 0, 2] = K[..., 2, 0] = m[..., 2, 0] + m[..., 0, 2]
    K[..., 1, 2] = K[..., 2, 1] = m[..., 2, 1] + m[..., 1, 2]
    K[..., 0, 3] = K[..., 3, 0] = m[..., 2, 1] - m[..., 1, 2]
    K[..., 1, 3] = K[..., 3, 1] = m[..., 0, 2] - m[..., 2, 0]
    K[..., 2, 3] = K[..., 3, 2] = m[..., 1, 0] - m[..., 0, 1]
    longest = np.argmax(np.einsum("...ii->...i", K), axis=-1)
    q = np.take_along_axis(K, longest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.sqrt(squared_norm(q))[..., None]
    return np.where(q[..., 3:] < 0.0, -q, q)


def quaternion_of(
    row_x: Sequence[float], row_y: Sequence[float], row_z: Sequence[float]
) -> tuple[float, float, float, float]:
    """The same of one matrix by its rows, a dozen times quicker: every frame needs three. Longer rows are as well."""
    xx, xy, xz, *_ = row_x
    yx, yy, yz, *_ = row_y
    zx, zy, zz, *_ = row_z
    squares = (1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz, 1.0 + xx + yy + zz)
    longest = squares.index(max(squares))
    if longest == 3:
        x, y, z, w = zy - yz, xz - zx, yx - xy, squares[3]
    elif longest == 0:
        x, y, z, w = squares[0], yx + xy, zx + xz, zy - yz
    elif longest == 1:
        x, y, z, w = yx + xy, squares[1], zy + yz, xz - zx
    else:
        x, y, z, w = zx + xz, zy + yz, squares[2], yx - xy
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if w < 0.0:
        length = -length
    return x / length, y / length, z / length, w / length


def quaternion_log(quaternion: ArrayLike) -> FloatArray:
    """Rotation vectors (..., 3), length in [0, pi], of unit quaternions x y z w (..., 4)."""
    q = np.asarray(quaternion, dtype=np.float64)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    v, w = q[..., :3], q[..., 3]
    sine = np.sqrt(squared_norm(v))
    tiny = sine < 1e-12
    # Near zero the angle is 2 sine / w, so the factor tends to 2 / w.
    factor = np.where(tiny, 2.0 / np.where(tiny, w, 1.0), 2.0 * np.arctan2(sine, w) / np.where(tiny, 1.0, sine))
    return np.asarray(factor[..., None] * v)


def so3_exp(rotation_vector: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad (Rodrigues)."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    angle = np.sqrt(squared_norm(w))
    a = np.sinc(angle / np.pi)[..., None, None]
    b = 0.5 * np.sinc(0.5 * angle / np.pi)[..., None, None] ** 2
    cross = hat(w)
    return np.eye(3) + a * cross + b * (cross @ cross)


def so3_log(R: ArrayLike) -> FloatArray:
    """Rotation vectors (..., 3), length in [0, pi], rad, of rotation matrices (..., 3, 3)."""
    return quaternion_log(matrix_to_quaternion(R))


def so3_left_jacobian(rotation_vector: ArrayLike) -> FloatArray:
    """Jl (..., 3, 3); the right Jacobian is that of the negative vector."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    x2 = squared_norm(w)
    b = 0.5 * np.sinc(0.5 * np.sqrt(x2) / np.pi)[..., None, None] ** 2
    cross = hat(w)
    return np.eye(3) + b * cross + sine_coefficient(x2)[..., None, None] * (cross @ cross)


def so3_left_jacobian_inverse(rotation_vector: ArrayLike) -> FloatArray:
    """Jl^-1 (..., 3, 3) for rotations below 2 pi; the right one is that of the negative vector."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    cross = hat(w)
    return np.eye(3) - 0.5 * cross + cot_coefficient(squared_norm(w))[..., None, None] * (cross @ cross)


def matrix_from_rpy(rpy: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of roll, pitch, yaw (..., 3), rad: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    half = 0.5 * np.asarray(rpy, dtype=np.float64)
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(half), -1, 0), np.moveaxis(np.sin(half), -1, 0)
    q = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    return quaternion_to_matrix(np.stack(q, axis=-1))


def rpy_of(T: ArrayLike) -> FloatArray:
    """Roll, pitch, yaw (..., 3), rad, of rotation or pose matrices (..., 3 or 4, 3 or 4); pitch in [-pi/2, pi/2].

    At pitch = +-pi/2 roll and yaw are not apart; their usual combination is returned.
    """
    m = np.asarray(T, dtype=np.float64)
    roll = np.arctan2(m[..., 2, 1], m[..., 2, 2])
    pitch = np.arctan2(-m[..., 2, 0], np.hypot(m[..., 0, 0], m[..., 1, 0]))
    return np.stack([roll, pitch, yaw_of(m)], axis=-1)


def yaw_of(T: ArrayLike) -> FloatArray:
    """Heading (...,), rad, of the x axis of rotation or pose matrices (..., 3 or 4, 3 or 4)."""
    m = np.asarray(T, dtype=np.float64)
    return np.asarray(np.arctan2(m[..., 1, 0], m[..., 0, 0]))
