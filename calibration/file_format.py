"""The calibration file: versioned JSON that a person can read, with a hash over its content. Text in, text out."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from calibration.fit import FitReport
from calibration.magnet_model import COUNT, PARAMETERS, NominalWhisker
from calibration.neighbours import with_array
from calibration.polynomial import FloatArray, PolynomialModel, monomials

FORMAT = "robominer-slam calibration"
VERSION = 2
#: Version 1 had polynomials only: no parameters, no variance by inclination, no neighbours.
READABLE = (1, 2)
REPRESENTATIONS = ("Cartesian", "Direction")
#: How far a whisker of the layout may be from where the calibration has it, m.
SAME_PLACE = 0.001


class CalibrationFileError(ValueError):
    """A calibration that cannot be used; one line that says what, where and what was expected."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """A calibration and its array; `p_base`, shape (n, 3), m, NaN where unfitted, is where its whiskers were."""

    array_id: str
    layout: str
    rows: int
    cols: int
    date: str
    model: PolynomialModel
    p_base: FloatArray | None = None


def _digest(content: dict[str, Any]) -> str:
    text = json.dumps({k: v for k, v in content.items() if k != "hash"}, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def to_text(report: FitReport, *, array_id: str, layout: str, rows: int, cols: int, date: str) -> str:
    """The file's text for a fit of an array."""
    model = report.model
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "array_id": array_id,
        "layout": layout,
        "rows": rows,
        "cols": cols,
        "date": date,
        "representation": model.representation,
        "folded": model.folded,
        "degree": model.degree,
        "nominal": asdict(report.nominal),
        "cross_validated_rms_deg": {str(d): _degrees(e) for d, e in report.degree_errors.items()},
        "whiskers": [_whisker(report, int(i), cols) for i in np.flatnonzero(model.fitted)],
    }
    content["hash"] = _digest(content)
    return json.dumps(content, indent=1)


def _degrees(angle: float) -> float:
    return round(float(np.rad2deg(angle)), 4)


def _whisker(report: FitReport, i: int, cols: int) -> dict[str, Any]:
    model, coverage = report.model, report.coverage[i]
    whisker: dict[str, Any] = {
        "row": i // cols,
        "col": i % cols,
        "model": report.chosen[i],
        "samples": int(report.samples[i]),
        "outlier_share": round(float(report.outliers[i]), 4),
        "physical_rms_deg": _degrees(report.physical_error[i]),
        "polynomial_rms_deg": _degrees(report.polynomial_error[i]),
        "field_noise_mT": round(float(report.noise_mT[i]), 4),
        "sigma_deg": float(np.rad2deg(model.sigma[i])),
        "max_inclination_deg": float(np.rad2deg(model.max_inclination[i])),
        "azimuth_eighths": "" if coverage is None else "".join("x" if seen else "-" for seen in coverage.sectors),
        "polarity": int(report.polarity[i]),
        "parameters": dict(zip(PARAMETERS, report.parameters[i].tolist(), strict=True)),
        "parameter_sigma": dict(zip(PARAMETERS, report.parameter_sigma[i].tolist(), strict=True)),
        "rest_mT": model.rest_mT[i].tolist(),
        "coefficients_rad": model.coefficients[i].tolist(),
    }
    if model.variance is not None:
        whisker["variance_rad2"] = model.variance[i].tolist()
    if report.geometry is not None:
        whisker["position_m"] = report.geometry[0][i].tolist()
        whisker["rotation"] = report.geometry[1][i].tolist()
    return whisker


def from_text(text: str, where: str) -> Calibration:
    """Parse a calibration file's text.

    Raises:
        CalibrationFileError: not a calibration, another version, damaged, or with values that do not fit.
    """
    try:
        content = json.loads(text)
    except ValueError as error:
        raise CalibrationFileError(f"{where}: not JSON ({error}); expected a calibration file") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CalibrationFileError(f"{where}: not a calibration file; make one with 'robominer-slam calibrate fit'")
    if content.get("version") not in READABLE:
        raise CalibrationFileError(
            f"{where}: version {content.get('version')}, expected {VERSION}; fit again or update the program"
        )
    if content.get("hash") != _digest(content):
        raise CalibrationFileError(f"{where}: its hash does not fit its content: damaged or edited; fit again")
    try:
        rows, cols = int(content["rows"]), int(content["cols"])
        model, p_base = _model_of(content, rows * cols, cols)
        return Calibration(
            str(content["array_id"]), str(content["layout"]), rows, cols, str(content["date"]), model, p_base
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CalibrationFileError(f"{where}: a field is missing or does not fit ({error!r}); fit again") from error


def _model_of(content: dict[str, Any], n: int, cols: int) -> tuple[PolynomialModel, FloatArray | None]:
    degree = int(content["degree"])
    representation, folded = content.get("representation", "Cartesian"), content.get("folded", False)
    if representation not in REPRESENTATIONS or not isinstance(folded, bool):
        raise ValueError(f"representation {representation!r}, folded {folded!r}")
    with_variance = content["version"] > 1
    model = PolynomialModel(
        degree=degree,
        rest_mT=np.zeros((n, 3)),
        coefficients=np.zeros((n, monomials(np.zeros(3), degree).size, 2)),
        sigma=np.zeros(n),
        max_inclination=np.zeros(n),
        fitted=np.zeros(n, dtype=np.bool_),
        variance=np.zeros((n, 3)) if with_variance else None,
        representation=representation,
        folded=folded,
    )
    parameters, polarity = np.zeros((n, COUNT)), np.ones(n)
    position, rotation = np.full((n, 3), np.nan), np.zeros((n, 3, 3))
    for whisker in content["whiskers"]:
        i = int(whisker["row"]) * cols + int(whisker["col"])
        model.rest_mT[i] = whisker["rest_mT"]
        model.coefficients[i] = whisker["coefficients_rad"]
        model.sigma[i] = np.deg2rad(whisker["sigma_deg"])
        model.max_inclination[i] = np.deg2rad(whisker["max_inclination_deg"])
        model.fitted[i] = True
        if model.variance is not None:
            model.variance[i] = whisker["variance_rad2"]
        if "position_m" in whisker:
            position[i], rotation[i] = whisker["position_m"], whisker["rotation"]
            parameters[i] = [whisker["parameters"][name] for name in PARAMETERS]
            polarity[i] = whisker["polarity"]
    if not model.fitted.any() or not np.isfinite(position[model.fitted]).all():
        return model, None
    nominal = NominalWhisker(**content["nominal"])
    return with_array(model, nominal, polarity, parameters, (position, rotation)), position


def check_fits(
    calibration: Calibration, *, layout: str, rows: int, cols: int, where: str, p_base: FloatArray | None = None
) -> None:
    """Refuse a calibration of another array; `p_base`, shape (n, 3), m, has where the layout's whiskers are.

    Raises:
        CalibrationFileError: its layout or size is not the configured one, or its whiskers were elsewhere.
    """
    if (calibration.layout, calibration.rows, calibration.cols) != (layout, rows, cols):
        raise CalibrationFileError(
            f"{where}: calibration of array {calibration.array_id!r}, layout {calibration.layout!r} "
            f"({calibration.rows} x {calibration.cols}); the robot's layout is {layout!r} ({rows} x {cols})"
        )
    if p_base is None or calibration.p_base is None:
        return
    off = np.nan_to_num(np.sqrt(np.square(calibration.p_base - p_base).sum(axis=-1)))
    if off.max() > SAME_PLACE:
        i = int(off.argmax())
        raise CalibrationFileError(
            f"{where}: whisker ({i // cols}, {i % cols}) was {off.max() * 1e3:.0f} mm from where layout {layout!r} has "
            "it; the layout has changed since: calibrate again"
        )
