"""`robominer-slam calibrate`: fit a calibration to jig data, and apply one to a table of readings."""

from __future__ import annotations

import csv
import datetime
import json
from pathlib import Path

import click
import numpy as np

from calibration.angle_estimator import AngleEstimator
from calibration.file_format import from_text, to_text
from calibration.fit import FitError, JigSamples, fit_jig
from robominer_slam.configuration.array import load_layout

JIG_COLUMNS = ("row", "col", "inclination_deg", "azimuth_deg", "bx_mT", "by_mT", "bz_mT")
READING_COLUMNS = ("row", "col", "bx_mT", "by_mT", "bz_mT")


@click.group()
def calibrate() -> None:
    """From magnetic vectors to angles: fit and apply the calibration of a whisker array."""


def read_table(path: Path, columns: tuple[str, ...]) -> list[list[float]]:
    """Rows of a CSV file's named columns.

    Raises:
        FitError: a column is missing, or a value is not a number; the message names file and line.
    """
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        missing = [name for name in columns if name not in (reader.fieldnames or [])]
        if missing:
            raise FitError(f"{path}: lacks the columns {', '.join(missing)}; expected {', '.join(columns)}")
        rows = []
        for line, record in enumerate(reader, start=2):
            try:
                rows.append([float(record[name]) for name in columns])
            except (TypeError, ValueError):
                raise FitError(f"{path}, line {line}: expected numbers in {', '.join(columns)}") from None
    return rows


@calibrate.command(
    epilog="Example: robominer-slam calibrate fit --jig jig.csv --layout thesis-grid --out array-07.json"
)
@click.option("--jig", type=click.Path(exists=True, dir_okay=False, path_type=Path), required=True,
              help=f"CSV with the columns {', '.join(JIG_COLUMNS)}.")  # fmt: skip
@click.option("--layout", "layout_name", required=True, help="Built-in layout name, or path of a layout file.")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True, help="Calibration to write.")
@click.option("--array-id", default=None, help="Name of the array; the output's file name by default.")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def fit(jig: Path, layout_name: str, out: Path, array_id: str | None, as_json: bool) -> None:
    """Fit every whisker's model to jig data: known angles, measured fields."""
    layout = load_layout(layout_name, Path.cwd())
    samples = JigSamples.from_rows(read_table(jig, JIG_COLUMNS))
    report = fit_jig(samples, layout.rows, layout.cols)
    text = to_text(
        report,
        array_id=array_id or out.stem,
        layout=layout.name,
        rows=layout.rows,
        cols=layout.cols,
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )
    out.write_text(text, encoding="utf-8")
    fitted = report.model.fitted
    sigma = np.rad2deg(report.model.sigma[fitted])
    figures = {
        "whiskers": int(fitted.sum()),
        "degree": report.model.degree,
        "rms_deg": float(np.sqrt(np.mean(sigma**2))),
        "worst_rms_deg": float(sigma.max()),
        "out": str(out),
    }
    if as_json:
        click.echo(json.dumps(figures))
    else:
        click.echo(
            f"{figures['whiskers']} whiskers, polynomial of degree {figures['degree']}; held-out error "
            f"{figures['rms_deg']:.2f} deg RMS, worst whisker {figures['worst_rms_deg']:.2f} deg; wrote {out}"
        )


@calibrate.command(epilog="Example: robominer-slam calibrate angles --calibration array-07.json readings.csv")
@click.option("--calibration", "calibration_file", required=True,
              type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Calibration to apply.")  # fmt: skip
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
def angles(calibration_file: Path, file: Path) -> None:
    """Angles of a CSV table of readings with the columns row, col, bx_mT, by_mT, bz_mT."""
    calibration = from_text(calibration_file.read_text(encoding="utf-8"), str(calibration_file))
    table = np.array(read_table(file, READING_COLUMNS)).reshape(-1, 5)
    place = (table[:, 0] * calibration.cols + table[:, 1]).astype(int)
    inside = (table[:, 0] < calibration.rows) & (table[:, 1] < calibration.cols) & (table[:, :2] >= 0).all(axis=1)
    if not inside.all():
        line = int(np.flatnonzero(~inside)[0]) + 2
        raise FitError(f"{file}, line {line}: expected a whisker of the {calibration.rows} x {calibration.cols} array")
    estimator = AngleEstimator(calibration.model)
    click.echo("row,col,bx_mT,by_mT,bz_mT,inclination_deg,azimuth_deg,sigma_deg")
    for line_values, i in zip(table, place, strict=True):
        field = np.zeros((estimator.count, 3))
        field[i] = line_values[2:]
        result = estimator.angles(field, np.ones(estimator.count, dtype=np.bool_))
        values = [result.inclination[i], result.azimuth[i], result.sigma[i]] if result.valid[i] else [np.nan] * 3
        degrees = ",".join(f"{v:.4f}" for v in np.rad2deg(values))
        b = ",".join(f"{v:g}" for v in line_values[2:])
        click.echo(f"{int(line_values[0])},{int(line_values[1])},{b},{degrees}")
