"""The data-driven whisker model: a polynomial from field to tilt, straight from the samples, whisker by whisker.

Elastomer-magnet sensors are fitted with polynomials throughout the literature. The degree with the least held-out
error serves the array. Robust by iterated weights; singular directions are cut, as the field of a tilting magnet is
a surface in space and its strength says little that its direction does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import direction_error_squared
from calibration.polynomial import FloatArray, dipole_coordinates, monomials
from calibration.robust import trimmed_rms, used_median

DEGREES: tuple[int, ...] = (2, 3, 4, 5)
#: Eigenvalues of the normal equations below this share of the largest are noise.
EIGENVALUE_CUTOFF = 1e-8
#: Rounds of weighing outliers down before the degrees are compared.
ROBUST_ROUNDS = 3
#: Scale of Geman and McClure's kernel on the squared error over its median.
KERNEL = 16.0


@dataclass(frozen=True, slots=True)
class DataDrivenFit:
    """Result for n whiskers.

    Attributes:
        degree: of the polynomials.
        coefficients: shape (n, terms, 2), rad.
        held_out: squared error of every sample when held out, shape (n, m), rad2.
        degree_errors: held-out RMS over the array by degree, rad.
        r_squared: explained share of the tilt's variance at degree 5, held out, shape (n,).
    """

    degree: int
    coefficients: FloatArray
    held_out: FloatArray
    degree_errors: dict[int, float]
    r_squared: FloatArray


def fit_data_driven(
    field_mT: FloatArray, tilt: FloatArray, weight: FloatArray, fold: NDArray[np.intp], rest_mT: FloatArray
) -> DataDrivenFit:
    """Fit n whiskers.

    Args:
        field_mT: shape (n, m, 3), mT, as sent.
        tilt: shape (n, m, 2), rad.
        weight: 1 or 0, shape (n, m).
        fold: of each sample for cross-validation, shape (n, m).
        rest_mT: shape (n, 3), mT.
    """
    largest = DEGREES[-1]
    features = monomials(dipole_coordinates(field_mT, rest_mT[:, None, :]), largest)
    terms = {degree: monomials(np.zeros(3), degree).size for degree in DEGREES}
    used = weight
    for _ in range(ROBUST_ROUNDS):
        some = features[..., : terms[3]]
        error = direction_error_squared(some @ _solve(*_normal(some, tilt, used)), tilt)
        median = used_median(error, weight)
        used = weight / np.square(1.0 + error / np.maximum(median, 1e-12)[:, None] / KERNEL)
    folds = int(fold.max()) + 1
    parts = [_normal(features, tilt, used * (fold == k)) for k in range(folds)]
    gram = np.sum([part[0] for part in parts], axis=0)
    moment = np.sum([part[1] for part in parts], axis=0)
    held_out: dict[int, FloatArray] = {}
    r_squared = np.zeros(len(tilt))
    for degree, count in terms.items():
        predicted = np.zeros_like(tilt)
        for k, (gram_k, moment_k) in enumerate(parts):
            left = _solve((gram - gram_k)[:, :count, :count], (moment - moment_k)[:, :count])
            predicted += np.where((fold == k)[..., None], features[..., :count] @ left, 0.0)
        held_out[degree] = direction_error_squared(predicted, tilt)
        w = used[..., None]
        spread = w * np.square(tilt - (w * tilt).sum(axis=1, keepdims=True) / w.sum(axis=1, keepdims=True))
        r_squared = 1.0 - (w * np.square(predicted - tilt)).sum((1, 2)) / np.maximum(spread.sum((1, 2)), 1e-12)
    errors = {d: float(np.sqrt(np.mean(trimmed_rms(e, weight) ** 2))) for d, e in held_out.items()}
    best = min(errors, key=lambda d: errors[d])
    coefficients = _solve(gram[:, : terms[best], : terms[best]], moment[:, : terms[best]])
    return DataDrivenFit(best, coefficients, held_out[best], errors, r_squared)


def _normal(features: FloatArray, tilt: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    weighted = (features * weight[..., None]).swapaxes(-1, -2)
    return weighted @ features, weighted @ tilt


def _solve(gram: FloatArray, moment: FloatArray) -> FloatArray:
    """Least squares from normal equations, small eigenvalues cut; shapes (n, t, t) and (n, t, 2)."""
    values, vectors = np.linalg.eigh(gram)
    keep = values > EIGENVALUE_CUTOFF * values[:, -1:]
    inverse = np.where(keep, 1.0 / np.where(keep, values, 1.0), 0.0)
    solution: FloatArray = vectors @ (inverse[..., None] * (vectors.swapaxes(-1, -2) @ moment))
    return solution
