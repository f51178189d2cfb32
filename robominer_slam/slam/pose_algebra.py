"""Rigid motions by dimension: poses (..., 3) in the plane, (..., 4, 4) in space, with one name for both."""

from __future__ import annotations

import numpy as np

from robominer_slam import geometry
from robominer_slam.geometry import FloatArray


def compose(dim: int, a: FloatArray, b: FloatArray) -> FloatArray:
    """Product a b."""
    return geometry.se2_compose(a, b) if dim == 2 else np.asarray(a @ b)


def inverse(dim: int, a: FloatArray) -> FloatArray:
    """Inverse a^-1."""
    return geometry.se2_inverse(a) if dim == 2 else geometry.inverse(a)


def adjoint(dim: int, a: FloatArray) -> FloatArray:
    """Adjoint, shape (..., d, d): a Exp(xi) a^-1 = Exp(Ad(a) xi)."""
    return geometry.se2_adjoint(a) if dim == 2 else geometry.se3_adjoint(a)


def moved(M: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances M C M' of M x, shape (..., d, d)."""
    return np.asarray(M @ covariance @ np.swapaxes(M, -1, -2))
