"""Errors of planar edges and their Jacobians, with points and rotations as complex numbers.

A pose is a point p = x + i y and a heading theta; exp(i theta) turns. With Z^-1 = (z, zeta) the error pose
E = Z^-1 X_i^-1 X_j is the point z + exp(i (zeta - theta_i)) (p_j - p_i) at the heading zeta + theta_j - theta_i, and
its logarithm is (a - i w / 2) times that point, w being the heading and a = (w / 2) cot(w / 2). A real (3, 3)
Jacobian whose upper left block is a scaled rotation is two complex numbers per edge. All this is a handful of
operations on arrays: for a small graph their calls are what costs.

Conventions and the perturbation about a pivot are those of `pose_graph_residuals`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.geometry import FloatArray, wrap_angle

ComplexArray = NDArray[np.complex128]

#: Vanishes beside every angle but zero, where it makes the quotients below what they tend to.
_TINY = 1e-300
#: Below this half angle, rad, da/dw is its leading term: to 1e-13, where the closed form loses digits.
_LEADING_TERM_BELOW = 1e-4


def points(rows: FloatArray) -> ComplexArray:
    """The first two columns of rows (m, 3) as x + i y, shape (m,): a view, to read and to write."""
    xy: FloatArray = rows[:, :2]
    return xy.view(np.complex128)[:, 0]


def turns(angles: FloatArray) -> ComplexArray:
    """exp(i angle) of angles (m,), rad."""
    out = np.empty(angles.shape, dtype=np.complex128)
    np.cos(angles, out=out.real)
    np.sin(angles, out=out.imag)
    return out


def error_poses(poses: FloatArray, i: NDArray[np.int64], j: NDArray[np.int64], Z_inverse: FloatArray) -> FloatArray:
    """E = Z^-1 X_i^-1 X_j of edges (i, j), shape (m, 3); heading wrapped."""
    at_i = poses[i]
    E: FloatArray = poses[j] - at_i
    at = points(E)
    at *= turns(Z_inverse[:, 2] - at_i[:, 2])
    at += points(Z_inverse)
    E[:, 2] = wrap_angle(E[:, 2] + Z_inverse[:, 2])
    return E


def logarithms(E: FloatArray) -> FloatArray:
    """Twists Log(E), shape (m, 3), of poses (m, 3) whose headings are wrapped."""
    half = 0.5 * E[:, 2]
    e = E.copy()
    points(e)[...] *= _half_cotangent(half) - 1j * half
    return e


def jacobians(E: FloatArray, at_j: FloatArray, pivot: FloatArray, full_logarithm: bool) -> FloatArray:
    """Derivatives (m, 3, 3) of the edges' errors by d_j, those by d_i being the negative ones.

    Args:
        E: error poses, shape (m, 3).
        at_j: poses X_j of the edges, shape (m, 3).
        pivot: point that the perturbations are about, shape (2,), m.
        full_logarithm: whether errors are Log(E), or E itself.
    """
    w = E[:, 2]
    columns = np.zeros((E.shape[0], 3, 3))
    columns[:, 2, 2] = 1.0
    across = points(columns[:, 1])
    lever = points(at_j) - complex(*pivot.tolist())
    if full_logarithm:
        half = 0.5 * w
        a = _half_cotangent(half)
        along = (a + 1j * half) * turns(-at_j[:, 2])
        np.multiply(along, 1j, out=across)
        points(columns[:, 2])[...] = across * lever + (_slope(half, a) - 0.5j) * points(E)
    else:
        along = turns(w - at_j[:, 2])
        np.multiply(along, 1j, out=across)
        points(columns[:, 2])[...] = across * lever
    points(columns[:, 0])[...] = along
    return columns.swapaxes(-1, -2)


def _half_cotangent(half: FloatArray) -> FloatArray:
    """A = (w / 2) cot(w / 2) of half angles w / 2, shape (m,)."""
    safe = half + _TINY
    return np.asarray(safe / np.tan(safe))


def _slope(half: FloatArray, a: FloatArray) -> FloatArray:
    """da/dw of half angles and their a, shape (m,)."""
    leading = np.abs(half) < _LEADING_TERM_BELOW
    return np.where(leading, half / -3.0, 0.5 * (a * (1.0 - a) / (half + _TINY) - half))


def perturbed(poses: FloatArray, steps: FloatArray, pivot: FloatArray) -> FloatArray:
    """C Exp(d) C^-1 X per node: the poses (n, 3) after `steps` (n, 3) about `pivot` (2,); headings wrapped."""
    half = 0.5 * steps[:, 2] + _TINY
    turn = turns(half)
    centre = complex(*pivot.tolist())
    # Exp(v, w) moves by exp(i w / 2) sin(w / 2) / (w / 2) v, which keeps its digits at any angle.
    chord = turn.imag / half * points(steps)
    moved = poses + steps
    moved[:, 2] = wrap_angle(moved[:, 2])
    points(moved)[...] = centre + turn * (turn * (points(poses) - centre) + chord)
    return moved
