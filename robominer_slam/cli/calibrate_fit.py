"""`robominer-slam calibrate fit` and `angles`: fit a calibration to known poses, and apply one to readings."""

from __future__ import annotations

import datetime
import json
from pathlib import Path

import click
import numpy as np

from calibration.angle_estimator import AngleEstimator
from calibration.capture_labels import CaptureError
from calibration.file_format import to_text
from calibration.fit import FitError, JigSamples, fit_array
from calibration.samples import Samples
from robominer_slam.capture.recording import read_capture, samples_of
from robominer_slam.cli.csv_table import read_table
from robominer_slam.configuration.array import load_layout
from robominer_slam.configuration.calibration_file import read_calibration_file

JIG_COLUMNS = ("row", "col", "inclination_deg", "azimuth_deg", "bx_mT", "by_mT", "bz_mT")
READING_COLUMNS = ("row", "col", "bx_mT", "by_mT", "bz_mT")


FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FIT_EPILOG = """
\b
Examples:
  robominer-slam calibrate fit --capture array-07.mcap --out array-07.json
  robominer-slam calibrate fit --jig jig.csv --layout thesis-grid --out array-07.json
"""


@click.command(epilog=FIT_EPILOG)
@click.option("--jig", type=FILE, help=f"CSV with the columns {', '.join(JIG_COLUMNS)}.")
@click.option("--capture", "captures", multiple=True, type=FILE, help="Recording of 'calibrate capture'; repeat for "
              "captures of several methods.")  # fmt: skip
@click.option("--layout", "layout_name", help="Built-in layout name, or path of a layout file; a capture has its own.")
@click.option("--folded", is_flag=True, help="The firmware negates readings whose z is negative.")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True, help="Calibration to write.")
@click.option("--array-id", default=None, help="Name of the array; the output's file name by default.")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def fit(
    jig: Path | None,
    captures: tuple[Path, ...],
    layout_name: str | None,
    folded: bool,
    out: Path,
    array_id: str | None,
    as_json: bool,
) -> None:
    """Fit every whisker's model to known poses: a jig's table, or captures."""
    if jig is None and not captures:
        raise click.UsageError("expected --jig FILE.csv or --capture FILE.mcap")
    samples: list[Samples] = []
    layout = None if layout_name is None else load_layout(layout_name, Path.cwd())
    for path in captures:
        one = read_capture(path)
        if layout is not None and (one.layout.name, one.layout.rows, one.layout.cols) != (
            layout.name,
            layout.rows,
            layout.cols,
        ):
            raise CaptureError(f"{path}: a capture of layout {one.layout.name!r}, expected {layout.name!r}")
        layout = layout or one.layout
        samples += samples_of(one)
    if jig is not None:
        samples.append(JigSamples.from_rows(read_table(jig, JIG_COLUMNS)))
    if layout is None:
        raise click.UsageError("with --jig expected --layout")
    report = fit_array(samples, layout, folded=folded)
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


@click.command(epilog="Example: robominer-slam calibrate angles --calibration array-07.json readings.csv")
@click.option("--calibration", "calibration_file", required=True,
              type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Calibration to apply.")  # fmt: skip
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
def angles(calibration_file: Path, file: Path) -> None:
    """Angles of a CSV table of readings with the columns row, col, bx_mT, by_mT, bz_mT."""
    calibration = read_calibration_file(calibration_file)
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
        sigma = estimator.sigma(result.inclination)
        values = [result.inclination[i], result.azimuth[i], sigma[i]] if result.valid[i] else [np.nan] * 3
        degrees = ",".join(f"{v:.4f}" for v in np.rad2deg(values))
        b = ",".join(f"{v:g}" for v in line_values[2:])
        click.echo(f"{int(line_values[0])},{int(line_values[1])},{b},{degrees}")
