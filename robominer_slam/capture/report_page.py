"""The report of a calibration as one HTML page: overview of the array, residuals over the hemisphere, worst first."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibration.angle_estimator import AngleEstimator
from calibration.check import KnownFrames, WhiskerCheck, angle_errors
from calibration.file_format import Calibration

FloatArray = NDArray[np.float64]

#: Residuals above this share the top colour, deg.
TOP_DEG = 2.0
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #222; }
h1 { font-size: 1.5rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2rem; }
p.note { color: #555; } img { max-width: 100%; }
table { border-collapse: collapse; } th, td { padding: .2rem .8rem; text-align: right; border-bottom: 1px solid #ddd; }
th { border-bottom: 2px solid #888; } td.bad { color: #b00020; text-align: left; } td.good { color: #1b7837; }
.whiskers { display: grid; grid-template-columns: repeat(auto-fill, minmax(13rem, 1fr)); gap: .5rem; }
figure { margin: 0; text-align: center; } figcaption { font-size: .85rem; }
"""


@dataclass(frozen=True, slots=True)
class Residuals:
    """Errors of one whisker at given directions: shape (k,) each, rad; azimuth as predicted where none was given."""

    inclination: FloatArray
    azimuth: FloatArray
    error: FloatArray


def residuals(calibration: Calibration, poses: Sequence[KnownFrames]) -> dict[int, Residuals]:
    """Errors by whisker's place, a value per pose and whisker (RMS over its frames), or per frame of a sweep."""
    estimator = AngleEstimator(calibration.model)
    collected: dict[int, list[tuple[float, float, float]]] = {
        int(i): [] for i in np.flatnonzero(calibration.model.fitted)
    }
    for pose in poses:
        error, _, azimuth, _ = angle_errors(estimator, pose)
        sweep = not np.isfinite(pose.azimuth).any() and not pose.at_rest
        for i, values in collected.items():
            good = np.isfinite(error[:, i])
            if not good.any():
                continue
            if sweep:
                values += [(float(pose.inclination[i]), float(a), float(e)) for a, e in
                           zip(azimuth[good, i], error[good, i], strict=True)]  # fmt: skip
            else:
                where = pose.azimuth[i] if np.isfinite(pose.azimuth[i]) else 0.0
                values.append((float(pose.inclination[i]), float(where), float(np.sqrt(np.mean(error[good, i] ** 2)))))
    return {i: Residuals(*np.array(values).T) for i, values in collected.items() if values}


def page(calibration: Calibration, checks: Sequence[WhiskerCheck], errors: dict[int, Residuals]) -> str:
    """The page.

    Args:
        calibration: the calibration.
        checks: figures of a capture; empty without one.
        errors: of `residuals`; empty without a capture.
    """
    matplotlib.use("agg")
    model, cols = calibration.model, calibration.cols
    places = np.flatnonzero(model.fitted)
    sigma = np.rad2deg(model.sigma)
    rms = {i: float(np.rad2deg(np.sqrt(np.mean(one.error**2)))) for i, one in errors.items()}
    order = sorted(places.tolist(), key=lambda i: -rms.get(i, float(sigma[i])))
    title = f"Calibration of array {html.escape(calibration.array_id)}"
    summary = (
        f"{len(places)} of {calibration.rows * cols} whiskers, layout {html.escape(calibration.layout)} "
        f"({calibration.rows} x {cols}), fitted {html.escape(calibration.date)}. Held-out error "
        f"{np.sqrt(np.mean(sigma[places] ** 2)):.2f} deg RMS, worst whisker {sigma[places].max():.2f} deg."
    )
    parts = [f"<h1>{title}</h1><p>{summary}</p>", "<h2>Array</h2>", _image(_overview(calibration), "Array overview")]
    parts.append('<p class="note">Seen as the layout numbers it, row 0 on top; one sigma of the rod\'s direction. '
                 "Grey: no calibration.</p>")  # fmt: skip
    by_place = {one.row * cols + one.col: one for one in checks}
    parts.append("<h2>Whiskers, worst first</h2>" + _table(calibration, order, rms, by_place))
    if errors:
        parts.append(
            "<h2>Residuals over the hemisphere</h2>"
            '<p class="note">Each disc is a whisker seen along its axis: inclination outwards (rings every 30 deg), '
            f"azimuth 0 to the right. Colour: error of the direction, {TOP_DEG:g} deg and more in yellow. The "
            "RMS counts all poses of the capture alike.</p>"
        )
        largest = max(float(np.rad2deg(one.inclination.max())) for one in errors.values())
        discs = [
            f"<figure>{_image(_disc(errors[i], largest), f'whisker {divmod(i, cols)}')}"
            f"<figcaption>whisker {divmod(i, cols)}: {rms[i]:.2f} deg RMS</figcaption></figure>"
            for i in order
            if i in errors
        ]
        parts.append(f'<div class="whiskers">{"".join(discs)}</div>')
    else:
        parts.append('<p class="note">Residuals over the hemisphere need the capture: --capture FILE.mcap.</p>')
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _table(
    calibration: Calibration, order: Sequence[int], rms: dict[int, float], checks: dict[int, WhiskerCheck]
) -> str:
    model = calibration.model
    head = ["whisker", "sigma, deg", "calibrated to, deg", "rest field, mT"]
    if checks:
        head += ["capture RMS, deg", "worst, deg", "rest off, mT", "noise, mT", "verdict"]
    rows = []
    for i in order:
        cells = [
            str(divmod(i, calibration.cols)),
            f"{np.rad2deg(model.sigma[i]):.2f}",
            f"{np.rad2deg(model.max_inclination[i]):.0f}",
            f"{np.linalg.norm(model.rest_mT[i]):.1f}",
        ]
        row = "".join(f"<td>{cell}</td>" for cell in cells)
        if checks:
            one = checks[i]
            figures = (rms.get(i, np.nan), one.worst_deg, one.rest_off_mT, one.noise_mT)
            row += "".join(f"<td>{x:.2f}</td>" if np.isfinite(x) else "<td>-</td>" for x in figures)
            row += '<td class="good">pass</td>' if one.passed else f'<td class="bad">{html.escape(one.reason)}</td>'
        rows.append(f"<tr>{row}</tr>")
    return f"<table><tr>{''.join(f'<th>{name}</th>' for name in head)}</tr>{''.join(rows)}</table>"


def _overview(calibration: Calibration) -> Figure:
    rows, cols = calibration.rows, calibration.cols
    sigma = np.where(calibration.model.fitted, np.rad2deg(calibration.model.sigma), np.nan).reshape(rows, cols)
    figure = Figure(figsize=(max(4.0, 0.75 * cols + 1.6), max(2.2, 0.6 * rows + 0.8)), layout="constrained")
    axes = figure.subplots()
    shown = axes.imshow(np.ma.masked_invalid(sigma), cmap="viridis", vmin=0.0, aspect="auto")
    axes.set_facecolor("#cccccc")
    for row in range(rows):
        for col in range(cols):
            if np.isfinite(sigma[row, col]):
                dark = sigma[row, col] < 0.6 * np.nanmax(sigma)
                axes.text(col, row, f"{sigma[row, col]:.2f}", ha="center", va="center", fontsize=9,
                          color="white" if dark else "black")  # fmt: skip
    axes.set(xlabel="column", ylabel="row", xticks=range(cols), yticks=range(rows))
    figure.colorbar(shown, ax=axes, label="sigma, deg")
    return figure


def _disc(one: Residuals, largest_deg: float) -> Figure:
    figure = Figure(figsize=(2.2, 2.2), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    axes.scatter(one.azimuth, np.rad2deg(one.inclination), c=np.rad2deg(one.error), s=22, cmap="viridis", vmin=0.0,
                 vmax=TOP_DEG)  # fmt: skip
    axes.set_ylim(0.0, largest_deg + 5.0)
    axes.set_yticks(np.arange(30.0, largest_deg + 5.0, 30.0), labels=[])
    axes.set_xticks(np.deg2rad([0.0, 90.0, 180.0, 270.0]), labels=["0", "90", "180", "-90"], fontsize=8)
    axes.tick_params(pad=-1)
    return figure


def _image(figure: Figure, text: str) -> str:
    """The figure in the page itself, so that one file is all there is to send."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    encoded = base64.b64encode(data.getvalue()).decode()
    return f'<img alt="{html.escape(text)}" src="data:image/png;base64,{encoded}">'
