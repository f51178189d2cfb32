"""The calibration file: versioned JSON that a person can read, with a hash over its content. Text in, text out."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.fit import FitReport
from calibration.polynomial import PolynomialModel, monomials

FORMAT = "robominer-slam calibration"
VERSION = 1


class CalibrationFileError(ValueError):
    """A calibration that cannot be used; one line that says what, where and what was expected."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """A calibration and what it belongs to."""

    array_id: str
    layout: str
    rows: int
    cols: int
    date: str
    model: PolynomialModel


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
        "model": "polynomial",
        "degree": model.degree,
        "cross_validated_rms_deg": {str(d): round(float(np.rad2deg(e)), 4) for d, e in report.degree_errors.items()},
        "whiskers": [
            {
                "row": int(i // cols),
                "col": int(i % cols),
                "samples": int(report.samples[i]),
                "sigma_deg": float(np.rad2deg(model.sigma[i])),
                "max_inclination_deg": float(np.rad2deg(model.max_inclination[i])),
                "rest_mT": model.rest_mT[i].tolist(),
                "coefficients_rad": model.coefficients[i].tolist(),
            }
            for i in np.flatnonzero(model.fitted)
        ],
    }
    content["hash"] = _digest(content)
    return json.dumps(content, indent=1)


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
    if content.get("version") != VERSION:
        raise CalibrationFileError(
            f"{where}: version {content.get('version')}, expected {VERSION}; fit again or update the program"
        )
    if content.get("hash") != _digest(content):
        raise CalibrationFileError(f"{where}: its hash does not fit its content: damaged or edited; fit again")
    try:
        rows, cols, degree = int(content["rows"]), int(content["cols"]), int(content["degree"])
        n, terms = rows * cols, monomials(np.zeros(3), degree).size
        model = PolynomialModel(
            degree=degree,
            rest_mT=np.zeros((n, 3)),
            coefficients=np.zeros((n, terms, 2)),
            sigma=np.zeros(n),
            max_inclination=np.zeros(n),
            fitted=np.zeros(n, dtype=np.bool_),
        )
        for whisker in content["whiskers"]:
            i = int(whisker["row"]) * cols + int(whisker["col"])
            model.rest_mT[i] = whisker["rest_mT"]
            model.coefficients[i] = whisker["coefficients_rad"]
            model.sigma[i] = np.deg2rad(whisker["sigma_deg"])
            model.max_inclination[i] = np.deg2rad(whisker["max_inclination_deg"])
            model.fitted[i] = True
        return Calibration(str(content["array_id"]), str(content["layout"]), rows, cols, str(content["date"]), model)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CalibrationFileError(f"{where}: a field is missing or does not fit ({error!r}); fit again") from error


def check_fits(calibration: Calibration, *, layout: str, rows: int, cols: int, where: str) -> None:
    """Refuse a calibration of another array.

    Raises:
        CalibrationFileError: its layout or size is not the configured one.
    """
    if (calibration.layout, calibration.rows, calibration.cols) != (layout, rows, cols):
        raise CalibrationFileError(
            f"{where}: calibration of array {calibration.array_id!r}, layout {calibration.layout!r} "
            f"({calibration.rows} x {calibration.cols}); the robot's layout is {layout!r} ({rows} x {cols})"
        )
