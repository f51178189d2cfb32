"""`robominer-slam operator`: the remote operator's console."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from dataclasses import replace
from pathlib import Path

import click

from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.operator.foxglove_option import foxglove_option, show_in_foxglove


@click.command(
    epilog="""\b
Example: robominer-slam operator --connect tcp/127.0.0.1:7447
Example of a recording: robominer-slam operator --recording drive.mcap"""
)
@click.option("--connect", default="tcp/127.0.0.1:7447", show_default=True, help="Endpoint of the daemon.")
@click.option(
    "--credentials",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder with your bundle from `keys issue`, for tls/ endpoints.",
)
@click.option("--robot", default="rm3", show_default=True, help="The robot's id.")
@click.option("--timeout", default=5.0, show_default=True, help="How long to wait for the daemon at first, s.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to serve the page on.")
@click.option("--port", default=8080, show_default=True, type=click.IntRange(0, 65535), help="Port; 0: any free one.")
@click.option("--token", envvar="ROBOMINER_OPERATOR_TOKEN", help="What a browser must know; needed beyond loopback.")
@click.option(
    "--recording",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Open a recording (MCAP) instead of a robot.",
)
@click.option(
    "--config",
    "config_file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="With --recording: configuration; the recording's own by default.",
)
@foxglove_option
@click.option(
    "--open/--no-open", "browse", default=None, help="Open a browser here.  [default: where there is a display]"
)
def operator(
    connect: str,
    credentials: Path | None,
    robot: str,
    timeout: float,
    host: str,
    port: int,
    token: str | None,
    recording: Path | None,
    config_file: Path | None,
    foxglove_port: int | None,
    browse: bool | None,
) -> None:
    """The operator's console: the robot over Zenoh in, a web page out."""
    if importlib.util.find_spec("nicegui") is None:
        raise ConfigurationError("the console needs NiceGUI: pip install 'robominer-slam[operator]'")
    from robominer_slam.operator.access import is_loopback
    from robominer_slam.operator.link import MAX_MESSAGE_BYTES, RobotLink
    from robominer_slam.operator.recording_source import RecordingSource
    from robominer_slam.operator.web_server import ServerError, listening_socket, serve
    from robominer_slam.publishing.client_settings import client_settings

    if recording is not None and foxglove_port is not None:
        raise ConfigurationError("--foxglove: shows a robot; Foxglove opens a recording (MCAP) by itself")
    if not is_loopback(host) and not token:
        raise ConfigurationError(f"--host {host}: others could reach the robot there; give --token SECRET as well")
    try:
        listener = listening_socket(host, port)
    except ServerError as error:
        raise ConfigurationError(str(error)) from error
    with contextlib.ExitStack() as stack:
        stack.callback(listener.close)
        session: RobotLink | RecordingSource
        if recording is not None:
            session = stack.enter_context(RecordingSource(recording, config_file))
        else:
            settings = replace(client_settings(connect, credentials, timeout), max_message_bytes=MAX_MESSAGE_BYTES)
            link = stack.enter_context(RobotLink(settings, robot))
            show_in_foxglove(stack, link.bus, foxglove_port)
            session = link
        if browse is None:
            browse = sys.stdout.isatty() and bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        serve(session, listener, token, on_ready=_tell, browse=browse)


def _tell(address: str) -> None:
    click.echo(f"operator's console: {address}")
    sys.stdout.flush()
