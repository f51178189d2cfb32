"""Rigid motions in the plane, SE(2): poses (x, y, theta), twists (vx, vy, omega); metres and radians.

Vectorised over leading axes. Import these from `robominer_slam.geometry`, which states the conventions.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from robominer_slam.geometry_rotations import (
    FloatArray,
    cot_coefficient,
    cot_coefficient_slope,
    wrap_angle,
    yaw_of,
)


def rotation_2d(theta: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 2, 2) of angles (...,), rad."""
    angle = np.asarray(theta, dtype=np.float64)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def T_from_xyyaw(xyyaw: ArrayLike) -> FloatArray:
    """Pose matrices (..., 4, 4) in the plane z = 0 of (x, y, yaw), shape (..., 3)."""
    pose = np.asarray(xyyaw, dtype=np.float64)
    out = np.zeros((*pose.shape[:-1], 4, 4))
    out[..., :2, :2] = rotation_2d(pose[..., 2])
    out[..., :2, 3] = pose[..., :2]
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def xyyaw_of(T: ArrayLike) -> FloatArray:
    """(x, y, yaw), shape (..., 3), of pose matrices (..., 4, 4); z, roll and pitch are dropped."""
    m = np.asarray(T, dtype=np.float64)
    return np.stack([m[..., 0, 3], m[..., 1, 3], yaw_of(m)], axis=-1)


def _rotate_2d(x: FloatArray, y: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    c, s = np.cos(theta), np.sin(theta)
    return c * x - s * y, s * x + c * y


def se2_compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> FloatArray:
    """T_a_c (..., 3) of planar poses (..., 3); heading wrapped."""
    a, b = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, dtype=np.float64)
    x, y = _rotate_2d(b[..., 0], b[..., 1], a[..., 2])
    return np.stack([a[..., 0] + x, a[..., 1] + y, wrap_angle(a[..., 2] + b[..., 2])], axis=-1)


def se2_inverse(T_a_b: ArrayLike) -> FloatArray:
    """T_b_a (..., 3) of planar poses (..., 3)."""
    pose = np.asarray(T_a_b, dtype=np.float64)
    x, y = _rotate_2d(-pose[..., 0], -pose[..., 1], -pose[..., 2])
    return np.stack([x, y, wrap_angle(-pose[..., 2])], axis=-1)


def se2_exp(twist: ArrayLike) -> FloatArray:
    """Planar poses (..., 3) of twists (vx, vy, omega), shape (..., 3); heading wrapped."""
    xi = np.asarray(twist, dtype=np.float64)
    w = xi[..., 2]
    a = np.sinc(w / np.pi)
    b = 0.5 * w * np.sinc(0.5 * w / np.pi) ** 2  # (1 - cos w) / w
    vx, vy = xi[..., 0], xi[..., 1]
    return np.stack([a * vx - b * vy, b * vx + a * vy, wrap_angle(w)], axis=-1)


def se2_log(pose: ArrayLike) -> FloatArray:
    """Twists (vx, vy, omega), shape (..., 3), omega in (-pi, pi], of planar poses (..., 3)."""
    p = np.asarray(pose, dtype=np.float64)
    w = wrap_angle(p[..., 2])
    a = 1.0 - w * w * cot_coefficient(w * w)
    x, y = p[..., 0], p[..., 1]
    return np.stack([a * x + 0.5 * w * y, a * y - 0.5 * w * x, w], axis=-1)


def se2_adjoint(pose: ArrayLike) -> FloatArray:
    """Adjoints (..., 3, 3) of planar poses (..., 3), for twists (vx, vy, omega)."""
    p = np.asarray(pose, dtype=np.float64)
    out = np.zeros((*p.shape, 3))
    out[..., :2, :2] = rotation_2d(p[..., 2])
    out[..., 0, 2] = p[..., 1]
    out[..., 1, 2] = -p[..., 0]
    out[..., 2, 2] = 1.0
    return out


def se2_right_jacobian_inverse(twist: ArrayLike) -> FloatArray:
    """Jr^-1 (..., 3, 3) of twists (vx, vy, omega), |omega| < 2 pi.

    As in `se3_right_jacobian_inverse`: v = V^-1(omega) t, and V^-1 R = (V^-1)' because both are scaled
    rotations of the plane.
    """
    xi = np.asarray(twist, dtype=np.float64)
    w = xi[..., 2]
    pose = se2_exp(xi)
    x, y = pose[..., 0], pose[..., 1]
    c = cot_coefficient(w * w)
    a = 1.0 - w * w * c
    slope = -w * (2.0 * c + w * w * cot_coefficient_slope(w * w, c))  # da/dw
    out = np.zeros((*xi.shape, 3))
    out[..., 0, 0] = out[..., 1, 1] = a
    out[..., 0, 1] = -0.5 * w
    out[..., 1, 0] = 0.5 * w
    out[..., 0, 2] = slope * x + 0.5 * y
    out[..., 1, 2] = slope * y - 0.5 * x
    out[..., 2, 2] = 1.0
    return out


def se2_right_jacobian(twist: ArrayLike) -> FloatArray:
    """Jr (..., 3, 3) of twists (vx, vy, omega), |omega| < 2 pi."""
    return np.asarray(np.linalg.inv(se2_right_jacobian_inverse(twist)))


def levelled(T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A pose as x, y, heading, z, shape (4,), and the tilt R with R_map_base = R_z(heading) R, shape (3, 3)."""
    a, b, up, _ = T.tolist()
    yaw = math.atan2(b[0], a[0])
    c, s = math.cos(yaw), math.sin(yaw)
    tilt = [
        [c * ax + s * bx for ax, bx in zip(a[:3], b[:3], strict=True)],
        [c * bx - s * ax for ax, bx in zip(a[:3], b[:3], strict=True)],
        up[:3],
    ]
    return np.array([a[3], b[3], yaw, up[3]]), np.array(tilt)
