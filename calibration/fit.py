"""Fits the polynomial whisker model to jig data: known angles, measured fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.polynomial import FloatArray, PolynomialModel, dipole_coordinates, monomials, tilt_from_angles

DEGREES: tuple[int, ...] = (2, 3, 4, 5)
FOLDS = 5
#: Singular values below this share of the largest are noise: the field of a tilting magnet is a surface in space.
RELATIVE_CUTOFF = 1e-4
#: Less than ten times the sensor's noise is no magnet.
MIN_REST_FIELD_MT = 1.5
MIN_SAMPLES = 24
MIN_INCLINATION_RANGE = np.deg2rad(20.0)
#: Inclination below which a sample counts as rest.
REST_INCLINATION = np.deg2rad(1.0)
AZIMUTH_SECTORS = 8


class FitError(ValueError):
    """Data that cannot be fitted; the message names the whisker and what is missing."""


@dataclass(frozen=True, slots=True)
class JigSamples:
    """Samples of an array in a jig, shape (m,) each and (m, 3) for the field."""

    row: NDArray[np.intp]
    col: NDArray[np.intp]
    inclination: FloatArray
    azimuth: FloatArray
    field_mT: FloatArray

    @classmethod
    def from_rows(cls, rows: Sequence[Sequence[float]]) -> JigSamples:
        """Rows of row, col, inclination_deg, azimuth_deg, bx_mT, by_mT, bz_mT.

        Raises:
            FitError: no rows, or a value that is not finite.
        """
        table = np.asarray(rows, dtype=np.float64).reshape(-1, 7)
        if not len(table):
            raise FitError("the jig table has no rows")
        if not np.isfinite(table).all():
            line = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
            raise FitError(f"the jig table's row {line + 1} has a value that is not finite")
        return cls(
            table[:, 0].astype(np.intp),
            table[:, 1].astype(np.intp),
            np.deg2rad(table[:, 2]),
            np.deg2rad(table[:, 3]),
            table[:, 4:7],
        )


@dataclass(frozen=True, slots=True)
class FitReport:
    """What the fit found: angular error by cross-validation, per whisker (rad) and per degree tried (rad)."""

    model: PolynomialModel
    samples: NDArray[np.intp]
    degree_errors: dict[int, float]


def direction_error(tilt: FloatArray, truth: FloatArray) -> FloatArray:
    """Angle between the rod directions of two tilt vectors, shape (m, 2) each, rad."""
    cosine = np.sum(_direction(tilt) * _direction(truth), axis=-1)
    angle: FloatArray = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle


def _direction(tilt: FloatArray) -> FloatArray:
    phi = np.hypot(tilt[..., 0], tilt[..., 1])
    # np.sinc is sin(pi x) / (pi x), which is smooth at zero.
    return np.concatenate([tilt * np.sinc(phi / np.pi)[..., None], np.cos(phi)[..., None]], axis=-1)


def check_coverage(inclination: FloatArray, azimuth: FloatArray, whisker: str) -> None:
    """Refuse a sweep that cannot determine the model.

    Raises:
        FitError: too few samples, no rest, too small a range of inclination, sectors of azimuth not visited.
    """
    if len(inclination) < MIN_SAMPLES:
        raise FitError(f"{whisker}: {len(inclination)} samples, expected at least {MIN_SAMPLES}")
    if inclination.min() > REST_INCLINATION:
        raise FitError(f"{whisker}: no sample at rest (inclination up to {np.rad2deg(REST_INCLINATION):.0f} deg)")
    if inclination.max() < MIN_INCLINATION_RANGE:
        reach = np.rad2deg(inclination.max())
        raise FitError(f"{whisker}: inclination reaches {reach:.0f} deg, expected at least 20 deg")
    bent = inclination > REST_INCLINATION
    sector = np.floor((azimuth[bent] + np.pi) / (2 * np.pi) * AZIMUTH_SECTORS).astype(int) % AZIMUTH_SECTORS
    missing = sorted(set(range(AZIMUTH_SECTORS)) - set(sector.tolist()))
    if missing:
        names = ", ".join(f"{-180 + 45 * s} to {-135 + 45 * s}" for s in missing)
        raise FitError(f"{whisker}: no samples at azimuths {names} deg")


def fit_jig(samples: JigSamples, rows: int, cols: int, seed: int = 0) -> FitReport:
    """Fit every whisker that the samples name; the degree with the least cross-validated error serves the array.

    Args:
        samples: of any number of whiskers, at least 24 each, over all azimuths and from rest to 20 deg or more.
        rows, cols: size of the array; whiskers without samples are left unfitted.
        seed: of the folds' shuffle.

    Raises:
        FitError: samples outside the array, or a sweep that does not cover enough.
    """
    if (samples.row < 0).any() or (samples.col < 0).any() or (samples.row >= rows).any() or (samples.col >= cols).any():
        raise FitError(f"the jig table names whiskers outside the {rows} x {cols} array")
    n = rows * cols
    place = samples.row * cols + samples.col
    members = [np.flatnonzero(place == i) for i in range(n)]
    tilt = tilt_from_angles(samples.inclination, samples.azimuth)
    rest: FloatArray = np.zeros((n, 3))
    for i, member in enumerate(members):
        if len(member):
            check_coverage(samples.inclination[member], samples.azimuth[member], f"whisker ({i // cols}, {i % cols})")
            at_rest = member[samples.inclination[member] <= REST_INCLINATION]
            rest[i] = samples.field_mT[at_rest].mean(axis=0)
            strength = float(np.linalg.norm(rest[i]))
            if strength < MIN_REST_FIELD_MT:
                raise FitError(f"whisker ({i // cols}, {i % cols}): {strength:.2f} mT at rest: is its magnet there?")
    rng = np.random.default_rng(seed)
    folds = [rng.permutation(len(member)) % FOLDS for member in members]
    errors = {degree: _cross_validate(samples.field_mT, tilt, members, folds, rest, degree) for degree in DEGREES}
    fitted = np.array([len(member) > 0 for member in members])
    mean_error = {d: float(np.sqrt(np.mean(e[fitted] ** 2))) for d, e in errors.items()}
    degree = min(mean_error, key=lambda d: mean_error[d])
    terms = monomials(np.zeros(3), degree).size
    coefficients = np.zeros((n, terms, 2))
    reach = np.zeros(n)
    for i, member in enumerate(members):
        if len(member):
            u = dipole_coordinates(samples.field_mT[member], rest[i])
            coefficients[i] = _solve(monomials(u, degree), tilt[member])
            reach[i] = samples.inclination[member].max()
    model = PolynomialModel(degree, rest, coefficients, errors[degree], reach, fitted)
    return FitReport(model, np.array([len(member) for member in members]), mean_error)


def _solve(features: FloatArray, tilt: FloatArray) -> FloatArray:
    solution: FloatArray = np.asarray(np.linalg.lstsq(features, tilt, rcond=RELATIVE_CUTOFF)[0], dtype=np.float64)
    return solution


def _cross_validate(
    field: FloatArray,
    tilt: FloatArray,
    members: list[NDArray[np.intp]],
    folds: list[NDArray[np.intp]],
    rest: FloatArray,
    degree: int,
) -> FloatArray:
    """RMS angle between held-out and predicted rod directions per whisker, shape (n,), rad."""
    result = np.zeros(len(members))
    for i, (member, fold) in enumerate(zip(members, folds, strict=True)):
        if not len(member):
            continue
        features = monomials(dipole_coordinates(field[member], rest[i]), degree)
        squares = 0.0
        for k in range(FOLDS):
            held = fold == k
            predicted = features[held] @ _solve(features[~held], tilt[member[~held]])
            squares += float(np.sum(direction_error(predicted, tilt[member[held]]) ** 2))
        result[i] = np.sqrt(squares / len(member))
    return result
