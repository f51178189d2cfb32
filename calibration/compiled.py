"""Compiles the physical model to the live polynomial: one formula for the array, whatever was fitted.

The polynomial is the least-squares estimate over rods in all directions up to 78 degrees and over the sensor's
noise: seven sigma points a pose (the field itself, and sqrt(3) sigma along each axis both ways; Julier and Uhlmann,
"Unscented filtering", 2004). With the noise in it, the fit weighs the field's strength against its direction as a
minimum-variance estimator does, and needs no other regularisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.magnet_model import MagnetModel, fold, rod_direction
from calibration.physical_fit import PhysicalFit, tilt_covariance
from calibration.polynomial import FloatArray, dipole_coordinates, monomials, sigma_basis

#: Degree of the live polynomial: noise-free RMS over 0 to 45 deg is 0.064, 0.055, 0.046 deg at degree 4, 5, 6 (the
#: parameters' own error is 0.046 deg), beside 0.457 deg of a reading's noise.
LIVE_DEGREE = 5
RANGE = np.deg2rad(78.0)
POSES = 400
#: Readings whose Bz is this near to zero may be folded or not, mT: eight times the sensor's noise.
FOLD_MARGIN_MT = 1.0
#: Added to the normal equations' diagonal, relative.
RIDGE = 1e-11
VARIANCE_GROUPS = 10
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, slots=True)
class Compiled:
    """Live polynomials of n whiskers: see `PolynomialModel`."""

    rest_mT: FloatArray
    coefficients: FloatArray
    variance: FloatArray
    sigma: FloatArray


def dense_tilts(count: int = POSES, largest: float = RANGE) -> FloatArray:
    """Tilts that cover a disc evenly (Vogel's spiral), shape (count, 2), rad."""
    k = np.arange(count)
    phi, azimuth = largest * np.sqrt((k + 0.5) / count), k * GOLDEN_ANGLE
    return np.stack([phi * np.cos(azimuth), phi * np.sin(azimuth)], axis=-1)


def as_sent(field_mT: FloatArray, representation: str, folded: bool) -> FloatArray:
    """Fields as the device sends them: folded, or directions only; shape (..., 3)."""
    field = fold(field_mT) if folded else field_mT
    if representation == "Direction":
        field = field / np.maximum(np.sqrt(np.square(field).sum(axis=-1, keepdims=True)), 1e-9)
    return field


def direction_error_squared(tilt: FloatArray, truth: FloatArray) -> FloatArray:
    """Squared angle between the rod directions of two tilt vectors, shape (..., 2) each, rad2; chord for angle."""
    squared: FloatArray = np.square(rod_direction(tilt) - rod_direction(truth)).sum(axis=-1)
    return squared


def compile_physical(
    model: MagnetModel, fit: PhysicalFit, representation: str, folded: bool, degree: int = LIVE_DEGREE
) -> Compiled:
    """Live polynomials of all n whiskers of a physical fit."""
    n = len(fit.parameters)
    grid = dense_tilts()
    tilt = np.broadcast_to(grid, (n, *grid.shape))
    field = model.field(fit.parameters, tilt)
    rest = as_sent(model.field(fit.parameters, np.zeros((n, 1, 2)))[:, 0], representation, folded)
    points = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * np.sqrt(3.0)
    # Weights of the sigma points: 0 for the centre, 1/6 each; the centre gets one too, for the mean's sake.
    weight = np.array([0.25, *[0.125] * 6])
    terms = monomials(np.zeros(3), degree).size
    coefficients, variance = np.empty((n, terms, 2)), np.empty((n, 3))
    phi = np.sqrt(np.square(grid).sum(axis=-1))
    for i in range(n):
        # Folded fields jump at Bz = 0; such readings are refused, and the polynomial need not follow them.
        here = field[i, :, 2] * np.sign(rest[i, 2]) > FOLD_MARGIN_MT if folded else slice(None)
        pose, angle = grid[here], phi[here]
        noisy = field[i, here, None, :] + fit.noise_mT[i] * points
        u = dipole_coordinates(as_sent(noisy, representation, folded), rest[i])
        features = monomials(u, degree)
        weighted = (features * weight[:, None]).reshape(-1, terms)
        flat = features.reshape(-1, terms)
        gram = weighted.T @ flat
        gram[np.diag_indices(terms)] += RIDGE * np.trace(gram)
        coefficients[i] = np.linalg.solve(gram, weighted.T @ np.repeat(pose, len(points), axis=0))
        error = direction_error_squared(features @ coefficients[i], pose[:, None, :])
        variance[i] = fit_variance(angle, error[:, 1:].mean(axis=1))
    # Where the parameters are not known well, nor is the direction.
    sparse = dense_tilts(60)
    spread = tilt_covariance(model, fit, np.broadcast_to(sparse, (n, *sparse.shape)))
    angle = np.sqrt(np.square(sparse).sum(axis=-1))
    radial = sparse / angle[:, None]
    along = np.einsum("mi,nmij,mj->nm", radial, spread, radial)
    across = np.trace(spread, axis1=-2, axis2=-1) - along
    for i in range(n):
        variance[i] += fit_variance(angle, along[i] + across[i] * np.sinc(angle / np.pi) ** 2)
    return Compiled(rest, coefficients, variance, overall_sigma(variance))


def fit_variance(inclination: FloatArray, squared: FloatArray) -> FloatArray:
    """Coefficients over `sigma_basis` of squared errors, shape (m,), that are not negative anywhere; shape (3,)."""
    # Means over groups first: a single squared error says next to nothing, and its weight would depend on it.
    order = np.argsort(inclination, kind="stable")
    groups = np.array_split(order, min(VARIANCE_GROUPS, len(order)))
    middle = np.array([inclination[group].mean() for group in groups])
    mean = np.array([squared[group].mean() for group in groups])
    scale = 1.0 / np.maximum(mean, 0.1 * mean.mean() + 1e-12)
    found: FloatArray = np.linalg.lstsq(sigma_basis(middle) * scale[:, None], mean * scale, rcond=None)[0]
    if (sigma_basis(np.linspace(0.0, RANGE, 20)) @ found).min() <= 0.1 * mean.min():
        return np.array([mean.mean(), 0.0, 0.0])
    return found


def overall_sigma(variance: FloatArray, largest: float = RANGE) -> FloatArray:
    """RMS over inclinations from 0 to `largest` of variances, shape (n, 3); shape (n,), rad."""
    mean: FloatArray = np.sqrt((variance @ sigma_basis(np.linspace(0.0, largest, 20)).T).mean(axis=-1))
    return mean
