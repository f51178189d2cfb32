"""`robominer-slam calibrate report`: a calibration as one HTML page."""

from __future__ import annotations

from pathlib import Path

import click

from calibration.angle_estimator import AngleEstimator
from calibration.check import KnownFrames, check_array
from calibration.file_format import check_fits
from robominer_slam.capture.known_frames import known_frames
from robominer_slam.capture.recording import read_capture
from robominer_slam.configuration.calibration_file import read_calibration_file

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
EPILOG = """
\b
Example: robominer-slam calibrate report array-07.json --capture array-07.mcap --out report.html
"""


@click.command(epilog=EPILOG)
@click.argument("calibration_file", metavar="CALIBRATION", type=FILE)
@click.option("--capture", "capture_file", type=FILE, help="Capture to show residuals of.")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True, help="Page to write.")
def report(calibration_file: Path, capture_file: Path | None, out: Path) -> None:
    """Show a calibration on one HTML page: the array, the residuals of each whisker, worst first."""
    calibration = read_calibration_file(calibration_file)
    poses: list[KnownFrames] = []
    if capture_file is not None:
        capture = read_capture(capture_file)
        labels = capture.labels
        check_fits(calibration, layout=labels.layout, rows=labels.rows, cols=labels.cols, where=str(calibration_file))
        poses = known_frames(capture)
    try:
        # Half a second, and the board does not have it.
        from robominer_slam.capture import report_page
    except ModuleNotFoundError as error:
        raise click.UsageError(
            f"the report needs {error.name}: install it with pip install 'robominer-slam[operator]'"
        ) from error
    model = calibration.model
    checks = check_array(model, AngleEstimator(model), calibration.cols, poses) if poses else []
    out.write_text(report_page.page(calibration, checks, report_page.residuals(calibration, poses)), encoding="utf-8")
    click.echo(f"wrote {out}")
