"""`robominer-slam status`: what a running daemon says of itself."""

from __future__ import annotations

import json
import queue
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from drivers.ros_messages import deserialize
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.report_messages import DIAGNOSTIC_ARRAY, Level
from robominer_slam.publishing.zenoh_session import ZenohBus

FOLDER = click.Path(file_okay=False, path_type=Path)
#: A daemon that is there takes the connection at once.
CONNECT_TIMEOUT_S = 5.0
#: Keys of the whiskers that are not well, as `status_report.py` writes them: `whisker (row, column)`.
WHISKER = "whisker "
COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "red", Level.STALE: "magenta"}


@click.command(epilog="Example: robominer-slam status --connect tcp/127.0.0.1:7447")
@click.option("--connect", default="tcp/127.0.0.1:7447", show_default=True, help="Endpoint of the daemon.")
@click.option("--credentials", type=FOLDER, help="Folder with your bundle from `keys issue`, for tls/ endpoints.")
@click.option("--robot", default="rm3", show_default=True, help="The robot's id.")
@click.option("--timeout", default=12.0, show_default=True, help="How long to wait for an answer, s.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def status(connect: str, credentials: Path | None, robot: str, timeout: float, as_json: bool) -> None:
    """What a running daemon says of itself; it speaks once a second, and to remote links in short, each ten seconds."""
    messages: queue.Queue[bytes] = queue.Queue()
    settings = client_settings(connect, credentials, min(timeout, CONNECT_TIMEOUT_S))
    with ZenohBus(settings, f"robominer/{robot}") as bus:
        bus.subscriber("status", lambda received: messages.put(received.payload))
        try:
            payload = messages.get(timeout=timeout)
        except queue.Empty:
            raise click.ClickException(
                f"nothing on robominer/{robot}/status within {timeout:g} s: is the robot's id right, "
                "and is your name on its access list?"
            ) from None
    entries: list[Any] = list(deserialize(payload, DIAGNOSTIC_ARRAY).status)
    if as_json:
        described = [
            {
                "name": entry.name,
                "level": Level(entry.level).name,
                "message": entry.message,
                "values": {value.key: value.value for value in entry.values},
            }
            for entry in entries
        ]
        click.echo(json.dumps(described))
        return
    table = Table(title=f"robominer/{robot}")
    for column in ("part", "level", "says", "figures"):
        table.add_column(column)
    for entry in entries:
        level = Level(entry.level)
        shown = [value for value in entry.values if value.value and not value.key.startswith(WHISKER)]
        figures = "\n".join(f"{value.key} = {value.value}" for value in shown)
        table.add_row(entry.name, f"[{COLOURS[level]}]{level.name}[/]", entry.message, figures)
    Console().print(table)
    unwell = [
        (value.key.removeprefix(WHISKER).strip("()"), value.value)
        for entry in entries
        for value in entry.values
        if value.key.startswith(WHISKER)
    ]
    if unwell:
        whiskers = Table(title="whiskers left out of the map")
        for column in ("row, column", "state"):
            whiskers.add_column(column)
        for place, state in unwell:
            whiskers.add_row(place, state)
        Console().print(whiskers)
