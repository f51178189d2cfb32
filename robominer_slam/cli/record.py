"""`robominer-slam record`: raw sensors on the robot, or on the operator's side what comes over the link, as MCAP."""

from __future__ import annotations

import contextlib
import json
import logging
import signal
import threading
from pathlib import Path

import click

from drivers.recording_format import RecordingError
from drivers.recording_writer import RecordingWriter
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.recording.link_recorder import CHUNK_BYTES, LinkRecorder
from robominer_slam.recording.session import Recorder, RecordingSummary
from robominer_slam.recording.session import record as run_recording

log = logging.getLogger(__name__)

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
OUT = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
CONNECT_TIMEOUT_S = 5.0


@click.command(
    epilog="""\b
Example on the robot: robominer-slam record --config config.toml --out drive.mcap
Example of an operator: robominer-slam record --connect tls/robot:7448 --credentials alice --out seen.mcap"""
)
@click.option("--config", "config_file", type=FILE, help="Record the raw sensors of this configuration's robot.")
@click.option("--connect", help="Record what a daemon sends, such as tcp/127.0.0.1:7447 or tls/robot:7448.")
@click.option("--credentials", type=FOLDER, help="Folder with your bundle from `keys issue`, for tls/ endpoints.")
@click.option("--robot", default="rm3", show_default=True, help="With --connect: the robot's id.")
@click.option("--out", type=OUT, required=True, help="File to write (MCAP).")
@click.option("--max-time", type=click.FloatRange(min=0.0, min_open=True), help="End after so long, s.")
@click.option("--force", is_flag=True, help="Overwrite a file that is there.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def record(
    config_file: Path | None,
    connect: str | None,
    credentials: Path | None,
    robot: str,
    out: Path,
    max_time: float | None,
    force: bool,
    as_json: bool,
) -> None:
    """Record until Ctrl-C: the raw sensors (--config), or what comes over the link (--connect).

    Raw sensors come from the devices, or from the daemon on this machine if it runs: it has the devices then, and
    hands on what they measure.
    """
    if (config_file is None) == (connect is None):
        raise click.UsageError("expected either --config FILE (raw sensors) or --connect ENDPOINT (what is sent)")
    if out.is_file() and not force:
        raise RecordingError(f"{out}: is there already; give another name, or --force to overwrite it")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with contextlib.ExitStack() as stack:
        if config_file is not None:
            # Imported here: who records a link needs none of what the robot's side takes seconds to load.
            from robominer_slam.recording.raw_session import raw_recorder

            raw = stack.enter_context(raw_recorder(config_file, out))
            summary = _run(raw.recorder, raw.writer, stop, max_time)
            for device in raw.recorder.faults():
                log.warning("device %s: %s", device.name, device.fault or device.state)
            nothing = "no device has sent anything"
        else:
            settings = client_settings(str(connect), credentials, CONNECT_TIMEOUT_S)
            bus = stack.enter_context(ZenohBus(settings, f"robominer/{robot}"))
            writer = RecordingWriter(out, chunk_bytes=CHUNK_BYTES, metadata={"robot": robot, "link": str(connect)})
            summary = _run(LinkRecorder(bus, writer), writer, stop, max_time)
            nothing = (
                f"nothing came from robominer/{robot}: is the robot's id right, and is your name on its access list?"
            )
    if not summary.messages:
        if out.is_file():
            out.unlink()
        raise click.ClickException(f"{out} not written: {nothing}")
    _tell(summary, as_json)


def _run(
    recorder: Recorder, writer: RecordingWriter, stop: threading.Event, max_time: float | None
) -> RecordingSummary:
    try:
        return run_recording(recorder, writer, stop, max_time)
    except RecordingError as error:
        # A disk that is full is no mistake of the command's.
        raise click.ClickException(str(error)) from error


def _tell(summary: RecordingSummary, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(summary.as_dict()))
        return
    lost = f", {summary.dropped} came too fast and are lost" if summary.dropped else ""
    click.echo(
        f"{summary.file}: {summary.seconds:.1f} s, {summary.messages} messages, {summary.bytes / 1e6:.2f} MB{lost}"
    )
    for topic, count in sorted(summary.counts.items()):
        click.echo(f"  {count:>8}  {topic}")
