"""`robominer-slam calibrate capture`: leads the operator through a capture and records it."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click
from rich.console import Console

from calibration.capture_labels import METHODS, CaptureError, CaptureLabels, Method
from calibration.capture_plan import PlannedStep, plan, plan_from_rows
from drivers.recording_writer import RecordingWriter
from robominer_slam import layout as layouts
from robominer_slam.capture.device import WhiskerDevice, load_configuration
from robominer_slam.capture.recording import LABELS, LAYOUT
from robominer_slam.capture.screen import EventScreen, LiveScreen
from robominer_slam.capture.session import CaptureSession, SessionSettings
from robominer_slam.cli.csv_table import read_records
from robominer_slam.configuration.array import load_layout
from robominer_slam.configuration.model import Configuration
from robominer_slam.layout import WhiskerLayout

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
OUT = click.Path(dir_okay=False, path_type=Path)
EPILOG = """
\b
Examples:
  robominer-slam calibrate capture --config config.toml --method jig --out array-07.mcap
  robominer-slam calibrate capture --config config.toml --method floor --out array-07.mcap
  robominer-slam calibrate fit --capture array-07.mcap --out array-07.json
\b
A script is a CSV file of steps with the columns wait_s, row, col, inclination_deg, azimuth_deg, height_m,
direction_deg, dragged_m, as far as the method needs them; a row with inclination_deg 0 is the array at rest.
"""


@click.command(epilog=EPILOG)
@click.option("--config", "config_file", type=FILE, required=True, help="Configuration that names the device.")
@click.option("--device", help="Name of the whiskers' device; any that sends frames by default.")
@click.option("--method", type=click.Choice(METHODS), required=True, help="How the truth is known.")
@click.option("--out", type=OUT, required=True, help="Recording to write, FILE.mcap.")
@click.option("--whisker", "whiskers", multiple=True, help="ROW,COL: a jig that holds one at a time; repeat.")
@click.option("--script", type=FILE, help="CSV of steps instead of the built-in plan.")
@click.option("--auto", type=click.FloatRange(min=0.0), help="Go on by itself after so many seconds a step.")
@click.option("--frames", default=25, show_default=True, type=click.IntRange(min=5), help="Frames of each pose.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object per line instead of the live view.")
def capture(
    config_file: Path,
    device: str | None,
    method: Method,
    out: Path,
    whiskers: tuple[str, ...],
    script: Path | None,
    auto: float | None,
    frames: int,
    as_json: bool,
) -> None:
    """Capture known poses of the whiskers, step by step, into a recording that can be fitted now or later.

    Enter goes on, s and Enter leaves a step out. What does not cover enough is said at once and asked for again.
    """
    configuration, folder = load_configuration(config_file)
    layout = load_layout(configuration.robot.layout, folder)
    places = [_place(text, layout) for text in whiskers]
    if places and method != "jig":
        raise click.UsageError(f"--whisker goes with --method jig: {method} moves the whole array")
    length = float(layout.length[layout.present].mean())
    if script is not None:
        planned = plan_from_rows(method, read_records(script)[1], str(script))
    else:
        planned = plan(method, length=length, whiskers=places)
    settings = SessionSettings(frames=frames, auto_s=auto)
    done, problems = run_capture(configuration, layout, method, planned, out, settings, device=device, as_json=as_json)
    if as_json:
        return
    click.echo(f"{len(done.labels)} of {len(planned)} steps captured; wrote {out}")
    for number, problem in problems.items():
        click.echo(f"step {number + 1}: {problem}")


def run_capture(
    configuration: Configuration,
    layout: WhiskerLayout,
    method: Method,
    planned: list[PlannedStep],
    out: Path,
    settings: SessionSettings,
    *,
    device: str | None,
    as_json: bool,
) -> tuple[CaptureLabels, dict[int, str]]:
    """Do a plan and record it; returns the labels and what was wrong with steps that were passed over.

    Raises:
        CaptureError: the device is silent or has another size, or the input ends.
        RecordingError: the recording cannot be written.
    """
    attachments = {LAYOUT: layouts.to_json(layout).encode()}
    with contextlib.ExitStack() as stack:
        writer = stack.enter_context(RecordingWriter(out, attachments=attachments, metadata={"capture": method}))
        source = stack.enter_context(
            WhiskerDevice(configuration, layout.rows, layout.cols, device=device, writer=writer)
        )
        screen: EventScreen | LiveScreen = (
            EventScreen() if as_json else LiveScreen(layout.rows, layout.cols, Console(stderr=True))
        )
        stack.enter_context(screen)
        session = CaptureSession(source, screen, layout.present, layout.cols, settings)
        labels = CaptureLabels(method, layout.name, layout.rows, layout.cols, tuple(session.run(planned)))
        writer.attach(LABELS, labels.to_text().encode(), media_type="application/json")
    return labels, session.problems


def _place(text: str, layout: WhiskerLayout) -> tuple[int, int]:
    try:
        row, col = (int(part) for part in text.split(","))
    except ValueError:
        raise click.UsageError(f"--whisker {text}: expected ROW,COL as in 3,4") from None
    if not (0 <= row < layout.rows and 0 <= col < layout.cols) or not layout.present[row * layout.cols + col]:
        raise CaptureError(f"--whisker {text}: the layout {layout.name} ({layout.rows} x {layout.cols}) has none there")
    return row, col
