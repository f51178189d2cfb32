"""Polynomial whisker model: magnetic vector to tilt vector, for the whole array at once.

The tilt vector is (phi cos a, phi sin a), rad: inclination and azimuth as one smooth quantity, with nothing special
at zero inclination, where the azimuth means little. Each whisker has its own polynomial of total degree `degree` in
u = (B - B_rest) / scale. Elastomer-magnet sensors are fitted with polynomials of this kind throughout the
literature; what degree they need here is found by cross-validation (`fit.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@cache
def monomial_steps(degree: int) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], ...]:
    """How each degree's monomials follow from the degree below: (parent index, variable index) arrays."""
    steps = []
    previous: list[tuple[int, ...]] = [()]
    for size in range(1, degree + 1):
        current = list(combinations_with_replacement(range(3), size))
        index = {monomial: i for i, monomial in enumerate(previous)}
        parents = np.array([index[monomial[:-1]] for monomial in current], dtype=np.intp)
        variables = np.array([monomial[-1] for monomial in current], dtype=np.intp)
        steps.append((parents, variables))
        previous = current
    return tuple(steps)


def monomials(u: FloatArray, degree: int) -> FloatArray:
    """All monomials of the three components of u up to a total degree.

    Args:
        u: shape (..., 3), dimensionless.
        degree: 1 or more.

    Returns:
        shape (..., (degree + 1)(degree + 2)(degree + 3) / 6), the constant first.
    """
    parts = [np.ones((*u.shape[:-1], 1))]
    for parents, variables in monomial_steps(degree):
        parts.append(parts[-1][..., parents] * u[..., variables])
    return np.concatenate(parts, axis=-1)


def tilt_from_angles(inclination: FloatArray, azimuth: FloatArray) -> FloatArray:
    """Tilt vector (phi cos a, phi sin a), shape (..., 2), rad."""
    return np.stack([inclination * np.cos(azimuth), inclination * np.sin(azimuth)], axis=-1)


def angles_from_tilt(tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inclination in [0, pi) and azimuth in (-pi, pi] of a tilt vector of shape (..., 2), rad."""
    return np.hypot(tilt[..., 0], tilt[..., 1]), np.arctan2(tilt[..., 1], tilt[..., 0])


@dataclass(frozen=True, slots=True)
class PolynomialModel:
    """Polynomials of n whiskers.

    Attributes:
        degree: total degree.
        rest_mT: field at rest, shape (n, 3), mT.
        scale_mT: normalisation, shape (n,), mT.
        coefficients: shape (n, terms, 2), rad.
        sigma: one-sigma error of the rod's direction, shape (n,), rad.
        max_inclination: largest inclination that the fit has seen, shape (n,), rad.
        fitted: False where this whisker has no calibration, shape (n,).
    """

    degree: int
    rest_mT: FloatArray
    scale_mT: FloatArray
    coefficients: FloatArray
    sigma: FloatArray
    max_inclination: FloatArray
    fitted: NDArray[np.bool_]

    def tilt(self, field_mT: FloatArray) -> FloatArray:
        """Tilt vectors, shape (n, 2), rad, of one field reading per whisker, shape (n, 3), mT."""
        u = (field_mT - self.rest_mT) / self.scale_mT[:, None]
        features = monomials(u, self.degree)
        tilt: FloatArray = np.matmul(features[:, None, :], self.coefficients)[:, 0, :]
        return tilt
