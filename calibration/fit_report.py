"""What a fit of an array found, and the live model that it gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import LIVE_DEGREE, Compiled
from calibration.coverage import Coverage
from calibration.magnet_model import MagnetModel, NominalWhisker
from calibration.neighbours import with_array
from calibration.physical_fit import PaddedSamples, PhysicalFit
from calibration.polynomial import FloatArray, PolynomialModel
from calibration.samples import ArrayGeometry

Representation = Literal["Cartesian", "Direction"]


@dataclass(frozen=True, slots=True)
class FitReport:
    """What the fit found; arrays by whisker, row-major.

    Attributes:
        model: for the live program.
        samples: number of samples, shape (n,).
        degree_errors: held-out RMS of the data-driven model over the array, by degree, rad.
        chosen: `physical`, `polynomial` or `` (no samples), per whisker.
        physical_error, polynomial_error: held-out RMS of both models, shape (n,), rad. Against floor samples they
            have the spread of the drag in them.
        parameters, parameter_sigma: of the physical model, shape (n, 16), as `magnet_model.PARAMETERS`.
        polarity: +1 or -1, shape (n,).
        noise_mT: scatter of the fields about the physical model, shape (n,), mT.
        outliers: share of the samples that fit nowhere, shape (n,).
        coverage: per whisker; None without samples.
        r_squared: explained share of the tilt's variance by the data-driven model of degree 5, shape (n,).
        whisker, inclination, azimuth, residual: of every sample: whose, where, and the chosen model's held-out
            error, shape (s,) each, rad.
        nominal: drawing that the physical model started from.
        geometry: positions (n, 3), m, and mount rotations (n, 3, 3) of the layout; None without one.
    """

    model: PolynomialModel
    samples: NDArray[np.intp]
    degree_errors: dict[int, float]
    chosen: tuple[str, ...]
    physical_error: FloatArray
    polynomial_error: FloatArray
    parameters: FloatArray
    parameter_sigma: FloatArray
    polarity: FloatArray
    noise_mT: FloatArray
    outliers: FloatArray
    coverage: tuple[Coverage | None, ...]
    r_squared: FloatArray
    whisker: NDArray[np.intp]
    inclination: FloatArray
    azimuth: FloatArray
    residual: FloatArray
    nominal: NominalWhisker
    geometry: tuple[FloatArray, FloatArray] | None = None


def scatter(values: FloatArray, members: NDArray[np.intp], n: int) -> FloatArray:
    """Values of the fitted whiskers at their places in the array; zero elsewhere."""
    result = np.zeros((n, *values.shape[1:]))
    result[members] = values
    return result


def live_model(
    magnets: MagnetModel,
    fit: PhysicalFit,
    compiled: Compiled,
    data: PaddedSamples,
    members: NDArray[np.intp],
    n: int,
    layout: ArrayGeometry | None,
    representation: Representation,
    folded: bool,
) -> PolynomialModel:
    """The model for the live program, its whiskers at their places in the array of n."""
    fitted = np.zeros(n, dtype=np.bool_)
    fitted[members] = True
    reach = np.where(data.weight > 0.0, data.inclination, 0.0).max(axis=1)
    model = PolynomialModel(
        degree=LIVE_DEGREE,
        rest_mT=scatter(compiled.rest_mT, members, n),
        coefficients=scatter(compiled.coefficients, members, n),
        sigma=scatter(compiled.sigma, members, n),
        max_inclination=scatter(reach, members, n),
        fitted=fitted,
        variance=scatter(compiled.variance, members, n),
        representation=representation,
        folded=folded,
    )
    if layout is None:
        return model
    return with_array(
        model,
        magnets.nominal,
        scatter(magnets.polarity, members, n),
        scatter(fit.parameters, members, n),
        (layout.p_base, layout.R_base_whisker),
    )
