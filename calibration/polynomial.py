"""Polynomial whisker model: magnetic vector to tilt vector, for the whole array at once.

The tilt vector is (phi cos a, phi sin a), rad: inclination and azimuth as one smooth quantity, with nothing special
at zero inclination, where the azimuth means little. A dipole that tilts by phi in front of the sensor makes
B = k (-sin phi cos a, -sin phi sin a, 2 cos phi), so atan2(2 |B_xy|, B_z) along B_xy is its tilt already; what
levers, offsets and rotations add to that is smooth, and each whisker's own polynomial of total degree `degree` in
(dipole tilt, relative field strength) takes it out. Elastomer-magnet sensors are fitted with polynomials throughout
the literature; what degree they need here is found by cross-validation (`fit.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement, pairwise

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


def dipole_coordinates(field_mT: FloatArray, rest_mT: FloatArray) -> FloatArray:
    """Tilt of an ideal dipole that makes this field (rad, two components), and the field's relative strength.

    Args:
        field_mT: shape (..., 3), mT.
        rest_mT: field at rest, shape (..., 3), mT; its z tells which way the magnet is mounted.

    Returns:
        shape (..., 3).
    """
    upright = np.where(rest_mT[..., 2:] < 0.0, -1.0, 1.0) * field_mT
    # Uncalibrated whiskers have no rest field; 1 mT keeps their values finite.
    rest_strength = np.maximum(np.sqrt(np.sum(np.square(rest_mT), axis=-1)), 1.0)
    transverse = np.maximum(np.hypot(upright[..., 0], upright[..., 1]), 1e-9)
    factor = np.arctan2(2.0 * transverse, upright[..., 2]) / transverse
    strength = np.sqrt(transverse**2 + upright[..., 2] ** 2) / rest_strength - 1.0
    return np.stack([upright[..., 0] * factor, upright[..., 1] * factor, strength], axis=-1)


def tilt_from_angles(inclination: FloatArray, azimuth: FloatArray) -> FloatArray:
    """Tilt vector (phi cos a, phi sin a), shape (..., 2), rad."""
    return np.stack([inclination * np.cos(azimuth), inclination * np.sin(azimuth)], axis=-1)


def angles_from_tilt(tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inclination in [0, pi) and azimuth in (-pi, pi] of a tilt vector of shape (..., 2), rad."""
    return np.hypot(tilt[..., 0], tilt[..., 1]), np.arctan2(tilt[..., 1], tilt[..., 0])


def sigma_basis(inclination: FloatArray) -> FloatArray:
    """1, phi^2, phi^4, shape (..., 3): the variance of the rod's direction is a sum of these."""
    square = np.square(inclination)
    return np.stack([np.ones_like(square), square, square * square], axis=-1)


@dataclass(frozen=True, slots=True)
class PolynomialModel:
    """Polynomials of n whiskers: what a fit of whichever model is compiled to.

    Attributes:
        degree: total degree.
        rest_mT: field at rest, shape (n, 3), mT; of length 1 where only directions are sent.
        coefficients: shape (n, terms, 2), rad.
        sigma: one-sigma error of the rod's direction over all inclinations, shape (n,), rad.
        max_inclination: largest inclination that the fit has seen, shape (n,), rad.
        fitted: False where this whisker has no calibration, shape (n,).
        variance: coefficients of the variance of a single reading over `sigma_basis`, shape (n, 3), rad2; None
            takes `sigma` everywhere.
        neighbours: change of the field at the sensors with the change of the rods' directions in whisker axes from
            rest, shape (3 n, 3 n), mT; None leaves them out.
        base_to_sensor: field in base_link's axes to readings, shape (n, 3, 3), for Earth's field; None leaves it out.
        representation: `Cartesian` (mT) or `Direction` (unit vectors: a firmware that sends two angles only).
        folded: readings are negated where Bz < 0.
    """

    degree: int
    rest_mT: FloatArray
    coefficients: FloatArray
    sigma: FloatArray
    max_inclination: FloatArray
    fitted: NDArray[np.bool_]
    variance: FloatArray | None = None
    neighbours: FloatArray | None = None
    base_to_sensor: FloatArray | None = None
    representation: str = "Cartesian"
    folded: bool = False

    def tilt(self, field_mT: FloatArray) -> FloatArray:
        """Tilt vectors, shape (n, 2), rad, of one field reading per whisker, shape (n, 3), mT."""
        return PolynomialEvaluator(self).tilt(field_mT).T


class PolynomialEvaluator:
    """A model made ready for one reading after the other: few numpy calls, arrays laid out whisker last."""

    def __init__(self, model: PolynomialModel) -> None:
        """Lay out the model's coefficients."""
        n = len(model.rest_mT)
        self._polarity = np.where(model.rest_mT[:, 2] < 0.0, -1.0, 1.0)
        strength = np.maximum(np.sqrt(np.square(model.rest_mT).sum(axis=-1)), 1.0)
        self._inverse_strength = 1.0 / strength
        self._coefficients = np.ascontiguousarray(model.coefficients.transpose(2, 1, 0))
        # Every monomial is the product of two of at most half the degree (rounded up), which are few and come first. A
        # product of many rows at once costs less than numpy's calls for one degree after the other.
        self._features = np.ones((len(_exponents(model.degree)), n))
        self._steps = _products(model.degree)

    def tilt(self, field_mT: FloatArray) -> FloatArray:
        """Tilt vectors, shape (2, n), rad, of one field reading per whisker, shape (n, 3), mT."""
        # Whiskers last in memory too, not only in shape: the products below run along them.
        features = self._features
        u = features[1:4]
        np.multiply(field_mT.T, self._polarity, out=u)
        x, y, z = u
        transverse = np.maximum(np.hypot(x, y), 1e-9)
        strength = np.hypot(transverse, z)
        u[:2] *= np.arctan2(2.0 * transverse, z) / transverse
        np.multiply(strength, self._inverse_strength, out=z)
        z -= 1.0
        for rows, first, second in self._steps:
            np.multiply(features.take(first, axis=0), features.take(second, axis=0), out=features[rows])
        tilt: FloatArray = np.einsum("otn,tn->on", self._coefficients, features)
        return tilt


def _exponents(degree: int) -> list[tuple[int, ...]]:
    """Monomials up to a degree as sorted variables, in the order of `monomials`: (), (0,), (1,), (2,), (0, 0), ..."""
    return [one for size in range(degree + 1) for one in combinations_with_replacement(range(3), size)]


def _products(degree: int) -> list[tuple[slice, NDArray[np.intp], NDArray[np.intp]]]:
    """Rows of monomials, in the order of `_exponents`, each with the rows before it whose products they are.

    One degree after the other up to half of `degree`; all others at once.
    """
    half = (degree + 1) // 2
    wanted = _exponents(degree)
    place = {monomial: k for k, monomial in enumerate(wanted)}
    ends = [len(_exponents(size)) for size in range(1, half + 1)] + [len(wanted)]
    steps = []
    for begin, end in pairwise(ends):
        split = half if begin == ends[-2] else len(wanted[begin]) - 1
        made = wanted[begin:end]
        first = np.array([place[one[:split]] for one in made], dtype=np.intp)
        steps.append((slice(begin, end), first, np.array([place[one[split:]] for one in made], dtype=np.intp)))
    return steps
