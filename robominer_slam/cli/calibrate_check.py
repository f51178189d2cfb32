"""`robominer-slam calibrate check`: does an existing calibration still hold? Pass or fail per whisker."""

from __future__ import annotations

import json
import math
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from calibration.angle_estimator import AngleEstimator
from calibration.capture_labels import CaptureError
from calibration.capture_plan import check_plan
from calibration.check import CheckLimits, WhiskerCheck, check_array
from calibration.file_format import Calibration, check_fits
from robominer_slam.capture.device import load_configuration
from robominer_slam.capture.known_frames import known_frames
from robominer_slam.capture.recording import Capture, read_capture
from robominer_slam.capture.session import SessionSettings
from robominer_slam.cli.calibrate_capture import run_capture
from robominer_slam.configuration.array import calibration_path, load_layout
from robominer_slam.configuration.calibration_file import read_calibration_file

LIMITS = CheckLimits()
FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
EPILOG = """
\b
Examples:
  robominer-slam calibrate check --config config.toml
  robominer-slam calibrate check --config config.toml --bend 30 --save check.mcap
  robominer-slam calibrate check --calibration array-07.json --capture array-07.mcap --json
\b
Exit code: 0 all whiskers pass, 1 some fail, 2 it could not be checked.
"""


@click.command(epilog=EPILOG)
@click.option("--calibration", "calibration_file", type=FILE, help="Calibration; the configuration's by default.")
@click.option("--capture", "capture_file", type=FILE, help="Recording of 'calibrate capture' instead of a device.")
@click.option("--config", "config_file", type=FILE, help="Configuration that names the device.")
@click.option("--device", help="Name of the whiskers' device; any that sends frames by default.")
@click.option("--bend", type=click.FloatRange(1.0, 75.0), help="Ask for four bends to this inclination too, deg.")
@click.option("--auto", type=click.FloatRange(min=0.0), help="Go on by itself after so many seconds a step.")
@click.option("--frames", default=25, show_default=True, type=click.IntRange(min=5), help="Frames of each pose.")
@click.option("--save", type=click.Path(dir_okay=False, path_type=Path), help="Keep the capture, FILE.mcap.")
@click.option("--rest-limit", default=LIMITS.rest_deg, show_default=True, help="Inclination read at rest, deg.")
@click.option("--noise-limit", default=LIMITS.noise_mT, show_default=True, help="Noise per axis, mT.")
@click.option("--limit", default=LIMITS.direction_deg, show_default=True, help="Direction error, deg, and twice "
              "the calibration's sigma.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def check(
    calibration_file: Path | None,
    capture_file: Path | None,
    config_file: Path | None,
    device: str | None,
    bend: float | None,
    auto: float | None,
    frames: int,
    save: Path | None,
    rest_limit: float,
    noise_limit: float,
    limit: float,
    as_json: bool,
) -> None:
    """Check a calibration against a short fresh capture, from the device or from a recording."""
    if (capture_file is None) == (config_file is None):
        raise click.UsageError("expected one of --capture FILE.mcap and --config FILE.toml")
    if capture_file is not None:
        if calibration_file is None:
            raise click.UsageError("with --capture expected --calibration FILE")
        calibration = read_calibration_file(calibration_file)
        capture = read_capture(capture_file)
        _check_fits(calibration, capture, str(calibration_file))
    else:
        assert config_file is not None
        calibration, capture = _live(
            config_file, calibration_file, save, bend, device, SessionSettings(frames=frames, auto_s=auto)
        )
    if not any(label.done.is_rest for label in capture.labels.labels):
        raise CaptureError(f"{capture_file or 'capture'}: has no step at rest; capture one with inclination 0")
    limits = CheckLimits(rest_deg=rest_limit, noise_mT=noise_limit, direction_deg=limit)
    model = calibration.model
    found = check_array(model, AngleEstimator(model), calibration.cols, known_frames(capture), limits)
    passed = all(one.passed for one in found)
    if as_json:
        rows = [{**_without_nan(asdict(one)), "passed": one.passed} for one in found]
        click.echo(json.dumps({"array_id": calibration.array_id, "passed": passed, "whiskers": rows}))
    else:
        Console().print(_table(found, calibration.array_id))
        failed = sum(not one.passed for one in found)
        click.echo(f"{len(found) - failed} whiskers pass, {failed} fail")
    if not passed:
        sys.exit(1)


def _live(
    config_file: Path,
    calibration_file: Path | None,
    save: Path | None,
    bend: float | None,
    device: str | None,
    settings: SessionSettings,
) -> tuple[Calibration, Capture]:
    configuration, folder = load_configuration(config_file)
    layout = load_layout(configuration.robot.layout, folder)
    path = calibration_file or calibration_path(configuration, folder)
    if path is None:
        raise click.UsageError("the configuration names no calibration: expected --calibration FILE")
    calibration = read_calibration_file(path)
    check_fits(calibration, layout=layout.name, rows=layout.rows, cols=layout.cols, where=str(path))
    with tempfile.TemporaryDirectory() as temporary:
        out = save or Path(temporary) / "check.mcap"
        # The figures alone go to standard output: the steps' events would be in a script's way.
        run_capture(configuration, layout, "jig", check_plan(bend), out, settings, device=device, as_json=False)
        return calibration, read_capture(out)


def _check_fits(calibration: Calibration, capture: Capture, where: str) -> None:
    labels = capture.labels
    check_fits(calibration, layout=labels.layout, rows=labels.rows, cols=labels.cols, where=where)


def _without_nan(values: dict[str, object]) -> dict[str, object]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def _figure(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _table(found: list[WhiskerCheck], array_id: str) -> Table:
    table = Table(title=f"array {array_id}, worst first")
    for column in ("whisker", "rest off, mT", "rest reads, deg", "noise, mT", "RMS error, deg", "allowed, deg", ""):
        table.add_column(column, justify="right")
    for one in sorted(found, key=_rank):
        table.add_row(
            f"({one.row}, {one.col})",
            _figure(one.rest_off_mT, 2),
            _figure(one.rest_off_deg, 2),
            _figure(one.noise_mT, 3),
            _figure(one.direction_deg, 2),
            _figure(one.allowed_deg, 2),
            "[green]pass[/]" if one.passed else f"[red]{one.reason}[/]",
        )
    return table


def _rank(one: WhiskerCheck) -> tuple[bool, float]:
    """Failed ones first, then by the larger error."""
    errors = [error for error in (one.direction_deg, one.rest_off_deg) if math.isfinite(error)]
    return one.passed, -max(errors, default=0.0)
