"""Fits a whole array from a jig, ring plates or the floor: two models per whisker, the better by cross-validation.

Physical model first, as it also solves for poses that are not known; the data-driven polynomial is fitted on those
poses. Both are judged on held-out samples; the winner is compiled to the live polynomial (`compiled.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import (
    Compiled,
    compile_physical,
    direction_error_squared,
    fit_variance,
    overall_sigma,
)
from calibration.coverage import Coverage, check_capture, coverage_of
from calibration.data_driven import DataDrivenFit, fit_data_driven
from calibration.fit_report import FitReport, Representation, live_model, scatter
from calibration.magnet_model import MagnetModel, NominalWhisker, rod_direction
from calibration.neighbours import neighbour_matrix
from calibration.physical_fit import WARM_ITERATIONS, PaddedSamples, PhysicalFit, PhysicalFitter
from calibration.polynomial import FloatArray, tilt_from_angles
from calibration.robust import trimmed_rms
from calibration.sample_tables import as_calibrated, check_each, near_fold, padded, rest_fields
from calibration.samples import (
    ArrayGeometry,
    FitError,
    FloorFrames,
    JigSamples,
    RingSamples,
    Samples,
    poses,
)

__all__ = [
    "FitError",
    "FitReport",
    "FloorFrames",
    "JigSamples",
    "RingSamples",
    "direction_error",
    "fit_array",
    "fit_jig",
]

Choice = Literal["best", "physical", "polynomial"]
FOLDS = 3
#: The data-driven model is taken where its held-out error is below this share of the physical one's: it does not
#: extrapolate, and held-out errors are known to a few per cent.
CLEARLY_BETTER = 0.95
#: A sample this unlikely is an outlier (chi-square, three degrees of freedom: 1 in 10,000).
OUTLIER_CHI2 = 21.1
#: A whisker with more outliers than this has not been fitted.
LARGEST_OUTLIER_SHARE = 0.3


def direction_error(tilt: FloatArray, truth: FloatArray) -> FloatArray:
    """Angle between the rod directions of two tilt vectors, shape (..., 2) each, rad."""
    angle: FloatArray = 2.0 * np.arcsin(np.clip(np.sqrt(direction_error_squared(tilt, truth)) / 2.0, 0.0, 1.0))
    return angle


def fit_jig(samples: JigSamples, rows: int, cols: int, seed: int = 0) -> FitReport:
    """`fit_array` of jig samples without a layout: neighbours are then not compensated."""
    return _fit([samples], rows, cols, None, NominalWhisker(), "Cartesian", folded=False, choose="best", seed=seed)


def fit_array(
    samples: Sequence[Samples],
    layout: ArrayGeometry,
    *,
    nominal: NominalWhisker | None = None,
    representation: Representation = "Cartesian",
    folded: bool = False,
    choose: Choice = "best",
    seed: int = 0,
) -> FitReport:
    """Fit every whisker that the samples name.

    Args:
        samples: of one or more sources, mixed at will; at least 24 a whisker, from rest to 20 deg or more, all round.
        layout: the array.
        nominal: drawing and tolerances of the whiskers.
        representation: `Direction` where the firmware sends no magnitude; fields may then have any length.
        folded: the firmware negates readings whose Bz is negative; the samples were recorded so, or are folded here.
        choose: one model for all whiskers instead of the better one.
        seed: of the folds' shuffle.

    Raises:
        FitError: samples outside the array, or a capture that does not determine the model; the reason in a line.
    """
    drawing = nominal or NominalWhisker()
    return _fit(samples, layout.rows, layout.cols, layout, drawing, representation, folded, choose, seed)


def _fit(
    samples: Sequence[Samples],
    rows: int,
    cols: int,
    layout: ArrayGeometry | None,
    nominal: NominalWhisker,
    representation: Representation,
    folded: bool,
    choose: Choice,
    seed: int,
) -> FitReport:
    check_capture(samples)
    table = as_calibrated(poses(samples, rows, cols, layout), representation, folded)
    if folded:
        table = table.kept(~near_fold(table.field_mT, representation))
    members, index, weight = padded(table.whisker)
    check_each(table, index, weight, members, cols)
    rest = rest_fields(table, index, weight, members, cols, representation)
    magnets = MagnetModel(nominal, np.where(rest[:, 2] < 0.0, -1.0, 1.0))
    data = PaddedSamples(
        table.field_mT[index], table.inclination[index], table.inclination_sigma[index],
        table.azimuth[index], table.azimuth_sigma[index], weight, representation == "Direction", folded,
    )  # fmt: skip
    fitter = PhysicalFitter(magnets, data)
    parameters, tilt = fitter.start(rest)
    if layout is not None and (table.frame >= 0).any() and representation == "Cartesian":
        first = fitter.fit(parameters, tilt, iterations=WARM_ITERATIONS)
        parameters, tilt = first.parameters, first.tilt
        # By the known poses: that of an outlier follows its field anywhere.
        known = _known_tilt(data, first)
        change = _neighbour_change(magnets, table.frame[index], weight, members, layout, parameters, known)
        data = replace(data, field_mT=data.field_mT - change)
        rest = rest_fields(
            replace(table, field_mT=_flat(data.field_mT, index, weight, len(table.whisker))),
            index, weight, members, cols, representation,
        )  # fmt: skip
        fitter = PhysicalFitter(magnets, data)
    fit = fitter.fit(parameters, tilt)
    rng = np.random.default_rng(seed)
    fold = (rng.permutation(int(table.setting.max()) + 1) % FOLDS)[table.setting][index]
    truth = _known_tilt(data, fit)
    physical = _held_out_physical(fitter, fit, fold, truth)
    data_driven = fit_data_driven(data.field_mT, truth, weight, fold, rest)
    physical_error, polynomial_error = trimmed_rms(physical, weight), trimmed_rms(data_driven.held_out, weight)
    # Unknown azimuths come from the physical model: against them, the other one proves nothing.
    unknown = (np.isinf(data.azimuth_sigma) * weight).sum(axis=1) > 0.5 * weight.sum(axis=1)
    use_physical = (polynomial_error > CLEARLY_BETTER * physical_error) | unknown
    if choose != "best":
        use_physical = np.full(len(members), choose == "physical")
    compiled = compile_physical(magnets, fit, representation, folded)
    compiled = _with_data_driven(compiled, data_driven, use_physical, rest, truth, weight)
    n = rows * cols
    held_out = np.where(use_physical[:, None], physical, data_driven.held_out)
    outlier = (fit.chi2 > OUTLIER_CHI2 * np.square(fit.noise_mT / nominal.noise_mT)[:, None]) & (weight > 0.0)
    coverage: list[Coverage | None] = [None] * n
    chosen = [""] * n
    for k, i in enumerate(members):
        row = weight[k] > 0.0
        azimuth = np.arctan2(fit.tilt[k, row, 1], fit.tilt[k, row, 0])
        coverage[i] = coverage_of(data.inclination[k, row], azimuth)
        chosen[i] = "physical" if use_physical[k] else "polynomial"
    here = weight > 0.0
    samples_of = np.bincount(members, weight.sum(axis=1), n).astype(np.intp)
    spread = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
    return FitReport(
        model=live_model(magnets, fit, compiled, data, members, n, layout, representation, folded),
        samples=samples_of,
        degree_errors=data_driven.degree_errors,
        chosen=tuple(chosen),
        physical_error=scatter(physical_error, members, n),
        polynomial_error=scatter(polynomial_error, members, n),
        parameters=scatter(fit.parameters, members, n),
        parameter_sigma=scatter(spread, members, n),
        polarity=scatter(magnets.polarity, members, n),
        noise_mT=scatter(fit.noise_mT, members, n),
        outliers=scatter(outlier.sum(axis=1) / weight.sum(axis=1), members, n),
        coverage=tuple(coverage),
        r_squared=scatter(data_driven.r_squared, members, n),
        whisker=np.broadcast_to(members[:, None], weight.shape)[here],
        inclination=np.sqrt(np.square(fit.tilt).sum(axis=-1))[here],
        azimuth=np.arctan2(fit.tilt[..., 1], fit.tilt[..., 0])[here],
        residual=np.sqrt(held_out)[here],
        nominal=nominal,
        geometry=None if layout is None else (layout.p_base, layout.R_base_whisker),
    )


def _flat(field: FloatArray, index: NDArray[np.intp], weight: FloatArray, count: int) -> FloatArray:
    result = np.zeros((count, 3))
    here = weight > 0.0
    result[index[here]] = field[here]
    return result


def _known_tilt(data: PaddedSamples, fit: PhysicalFit) -> FloatArray:
    """Tilts as the source says them, with the fit's azimuths where it says none, shape (n, m, 2), rad."""
    found = np.arctan2(fit.tilt[..., 1], fit.tilt[..., 0])
    azimuth = np.where(np.isinf(data.azimuth_sigma), found, data.azimuth)
    return tilt_from_angles(data.inclination, azimuth)


def _held_out_physical(
    fitter: PhysicalFitter, fit: PhysicalFit, fold: NDArray[np.intp], truth: FloatArray
) -> FloatArray:
    """Squared error of every sample by the parameters that were fitted without it, shape (n, m), rad2."""
    squared = np.zeros(fold.shape)
    for k in range(FOLDS):
        held = fold == k
        left_out = fitter.fit(fit.parameters, fit.tilt, (~held).astype(np.float64), iterations=2)
        found = fitter.invert(left_out.parameters, fit.tilt)
        squared = np.where(held, direction_error_squared(found, truth), squared)
    return squared


def _with_data_driven(
    compiled: Compiled,
    data_driven: DataDrivenFit,
    use_physical: NDArray[np.bool_],
    rest: FloatArray,
    tilt: FloatArray,
    weight: FloatArray,
) -> Compiled:
    """The compiled models, with the data-driven polynomials where they are better."""
    terms = data_driven.coefficients.shape[1]
    inclination = np.sqrt(np.square(tilt).sum(axis=-1))
    for k in np.flatnonzero(~use_physical):
        compiled.rest_mT[k] = rest[k]
        compiled.coefficients[k] = 0.0
        compiled.coefficients[k, :terms] = data_driven.coefficients[k]
        here = weight[k] > 0.0
        error = data_driven.held_out[k, here]
        kept = error <= np.quantile(error, 0.98)
        compiled.variance[k] = fit_variance(inclination[k, here][kept], error[kept])
    return replace(compiled, sigma=overall_sigma(compiled.variance))


def _neighbour_change(
    magnets: MagnetModel,
    frame: NDArray[np.intp],
    weight: FloatArray,
    members: NDArray[np.intp],
    layout: ArrayGeometry,
    parameters: FloatArray,
    tilt: FloatArray,
) -> FloatArray:
    """What the neighbours' tilts of the same frames add to the fields, shape (k, m, 3), mT."""
    matrix = neighbour_matrix(layout.p_base[members], layout.R_base_whisker[members], magnets, parameters)
    here = (weight > 0.0) & (frame >= 0)
    direction = np.zeros((int(frame.max()) + 1, len(members), 3))
    who = np.broadcast_to(np.arange(len(members))[:, None], frame.shape)
    direction[frame[here], who[here]] = rod_direction(tilt[here]) - np.array([0.0, 0.0, 1.0])
    change = (direction.reshape(len(direction), -1) @ matrix.T).reshape(direction.shape)
    result: FloatArray = np.where(here[..., None], change[frame, who], 0.0)
    return result
