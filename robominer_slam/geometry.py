"""Rigid motions in the plane, SE(2), and in space, SE(3): vectorised over leading axes, numpy only.

Conventions, everywhere in the project:

- `T_a_b` is the pose of frame b in frame a: `p_a = T_a_b @ p_b`, `T_a_c = T_a_b @ T_b_c`. A pose in space is a
  4x4 homogeneous matrix, shape (..., 4, 4); a pose in the plane is (x, y, theta), shape (..., 3); m and rad.
- Quaternions are x y z w (REP-103's messages). Results have w >= 0.
- Twists put translation first: (v, omega), shape (..., 6), and (vx, vy, omega), shape (..., 3).
- Right Jacobian: Exp(xi + d) = Exp(xi) Exp(Jr(xi) d); its inverse: Log(Exp(xi) Exp(d)) = xi + Jr^-1(xi) d, to
  first order in d. The left ones are those of -xi.

Sources: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018); Barfoot, "State
Estimation for Robotics", chapter 7. Rotations alone are in `geometry_rotations`, motions in the plane in
`geometry_planar`; all their names can be had from here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from robominer_slam.geometry_planar import (
    T_from_xyyaw,
    levelled,
    rotation_2d,
    se2_adjoint,
    se2_compose,
    se2_exp,
    se2_inverse,
    se2_log,
    se2_right_jacobian,
    se2_right_jacobian_inverse,
    xyyaw_of,
)
from robominer_slam.geometry_rotations import (
    FloatArray,
    cot_coefficient,
    cot_coefficient_slope,
    hat,
    matrix_from_rpy,
    matrix_to_quaternion,
    quaternion_log,
    quaternion_of,
    quaternion_to_matrix,
    rpy_of,
    sine_coefficient,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
    squared_norm,
    wrap_angle,
    yaw_of,
)

__all__ = [
    "FloatArray",
    "T_from_xyyaw",
    "from_rotation_translation",
    "from_vector7",
    "hat",
    "inverse",
    "levelled",
    "matrix_from_rpy",
    "matrix_to_quaternion",
    "normalise_pose",
    "pose_matrix",
    "quaternion_log",
    "quaternion_to_matrix",
    "rotation_2d",
    "rpy_of",
    "se2_adjoint",
    "se2_compose",
    "se2_exp",
    "se2_inverse",
    "se2_log",
    "se2_right_jacobian",
    "se2_right_jacobian_inverse",
    "se3_adjoint",
    "se3_exp",
    "se3_left_jacobian",
    "se3_left_jacobian_inverse",
    "se3_log",
    "se3_right_jacobian",
    "se3_right_jacobian_inverse",
    "so3_exp",
    "so3_left_jacobian",
    "so3_left_jacobian_inverse",
    "so3_log",
    "squared_norm",
    "to_vector7",
    "transform_points",
    "wrap_angle",
    "xyyaw_of",
    "yaw_of",
]


def from_rotation_translation(R: ArrayLike, t: ArrayLike) -> FloatArray:
    """Pose matrices (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3), m."""
    rotation, translation = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    out = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def pose_matrix(xyz: ArrayLike, quaternion: ArrayLike) -> FloatArray:
    """Pose matrices (..., 4, 4) of positions (..., 3), m, and quaternions x y z w (..., 4)."""
    return from_rotation_translation(quaternion_to_matrix(quaternion), xyz)


def to_vector7(T: ArrayLike) -> FloatArray:
    """x, y, z, qx, qy, qz, qw (..., 7) of pose matrices (..., 4, 4)."""
    m = np.asarray(T, dtype=np.float64)
    if m.ndim == 2:
        rows = m.tolist()
        return np.array((rows[0][3], rows[1][3], rows[2][3], *quaternion_of(*rows[:3])))
    vector = np.empty((*m.shape[:-2], 7))
    vector[..., :3] = m[..., :3, 3]
    vector[..., 3:] = matrix_to_quaternion(m[..., :3, :3])
    return vector


def from_vector7(vector: ArrayLike) -> FloatArray:
    """Pose matrices (..., 4, 4) of x, y, z, qx, qy, qz, qw (..., 7)."""
    v = np.asarray(vector, dtype=np.float64)
    return pose_matrix(v[..., :3], v[..., 3:])


def inverse(T: ArrayLike) -> FloatArray:
    """Inverse of pose matrices (..., 4, 4)."""
    m = np.asarray(T, dtype=np.float64)
    R_transposed = np.swapaxes(m[..., :3, :3], -1, -2)
    return from_rotation_translation(R_transposed, -(R_transposed @ m[..., :3, 3:])[..., 0])


def transform_points(T_a_b: ArrayLike, p_b: ArrayLike) -> FloatArray:
    """Points (n, 3) of frame b in frame a, m, for one pose (4, 4), or (..., n, 3) for poses (..., 4, 4)."""
    T, p = np.asarray(T_a_b, dtype=np.float64), np.asarray(p_b, dtype=np.float64)
    return np.asarray(p @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3])


def normalise_pose(T: ArrayLike) -> FloatArray:
    """Poses (..., 4, 4) with the rounding of long products taken out of their rotations."""
    m = np.asarray(T, dtype=np.float64)
    return from_vector7(to_vector7(m))


def se3_exp(twist: ArrayLike) -> FloatArray:
    """Pose matrices (..., 4, 4) of twists (v, omega), shape (..., 6)."""
    xi = np.asarray(twist, dtype=np.float64)
    # As `so3_exp` and `so3_left_jacobian`, what the two share computed once.
    w = xi[..., 3:]
    x2 = squared_norm(w)
    angle = np.sqrt(x2)
    a, b = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    c = sine_coefficient(x2)
    cross = hat(w)
    cross2 = cross @ cross
    unit = np.eye(3)
    out = np.zeros((*xi.shape[:-1], 4, 4))
    out[..., :3, :3] = unit + a[..., None, None] * cross + b[..., None, None] * cross2
    out[..., :3, 3:] = (unit + b[..., None, None] * cross + c[..., None, None] * cross2) @ xi[..., :3, None]
    out[..., 3, 3] = 1.0
    return out


def se3_log(T: ArrayLike) -> FloatArray:
    """Twists (v, omega), shape (..., 6), |omega| <= pi, of pose matrices (..., 4, 4)."""
    m = np.asarray(T, dtype=np.float64)
    w = so3_log(m[..., :3, :3])
    return np.concatenate([(so3_left_jacobian_inverse(w) @ m[..., :3, 3:])[..., 0], w], axis=-1)


def se3_adjoint(T: ArrayLike) -> FloatArray:
    """Adjoints (..., 6, 6) of poses (..., 4, 4): T Exp(xi) T^-1 = Exp(Ad xi), xi = (v, omega)."""
    m = np.asarray(T, dtype=np.float64)
    R = m[..., :3, :3]
    out = np.zeros((*m.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = hat(m[..., :3, 3]) @ R
    return out


def se3_right_jacobian_inverse(twist: ArrayLike, translation: FloatArray | None = None) -> FloatArray:
    """Jr^-1 (..., 6, 6) of twists (v, omega), |omega| < 2 pi; `translation` (..., 3) of Exp(twist), if it is known.

    From Log itself: omega' = omega + Jr3^-1 d_omega, and v = V^-1(omega) t with t' = t + R d_v, where
    V^-1(omega) t = t - omega x t / 2 + c omega x (omega x t); the corner block is its derivative by omega.
    """
    xi = np.asarray(twist, dtype=np.float64)
    w = xi[..., 3:]
    t = (so3_left_jacobian(w) @ xi[..., :3, None])[..., 0] if translation is None else translation
    x2 = squared_norm(w)
    c = cot_coefficient(x2)
    cross = hat(w)
    cross2 = cross @ cross
    Jr_inverse = np.eye(3) + 0.5 * cross + c[..., None, None] * cross2
    wt = np.einsum("...i,...i->...", w, t)[..., None, None]
    column, row = w[..., :, None], w[..., None, :]
    by_omega = (
        0.5 * hat(t)
        + c[..., None, None] * (wt * np.eye(3) + column * t[..., None, :] - 2.0 * t[..., :, None] * row)
        + cot_coefficient_slope(x2, c)[..., None, None] * ((cross2 @ t[..., None]) * row)
    )
    out = np.zeros((*xi.shape[:-1], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = Jr_inverse
    out[..., :3, 3:] = by_omega @ Jr_inverse
    return out


def se3_left_jacobian_inverse(twist: ArrayLike) -> FloatArray:
    """Jl^-1 (..., 6, 6) of twists (v, omega), |omega| < 2 pi."""
    return se3_right_jacobian_inverse(-np.asarray(twist, dtype=np.float64))


def se3_right_jacobian(twist: ArrayLike) -> FloatArray:
    """Jr (..., 6, 6) of twists (v, omega), |omega| < 2 pi."""
    xi = np.asarray(twist, dtype=np.float64)
    Jr = so3_left_jacobian(-xi[..., 3:])
    out = se3_right_jacobian_inverse(xi)
    out[..., :3, 3:] = -(Jr @ out[..., :3, 3:] @ Jr)
    out[..., :3, :3] = out[..., 3:, 3:] = Jr
    return out


def se3_left_jacobian(twist: ArrayLike) -> FloatArray:
    """Jl (..., 6, 6) of twists (v, omega), |omega| < 2 pi."""
    return se3_right_jacobian(-np.asarray(twist, dtype=np.float64))
