"""`robominer-slam status`: what a running daemon says of itself."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Callable
from pathlib import Path

import click
from rich.console import Console, Group
from rich.live import Live

from robominer_slam.cli.status_table import described, entries_of, tables
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.zenoh_session import ZenohBus

FOLDER = click.Path(file_okay=False, path_type=Path)
#: A daemon that is there takes the connection at once.
CONNECT_TIMEOUT_S = 5.0
#: How often a picture that waits for news says for how long.
WAITING_S = 1.0


@click.command(epilog="Example: robominer-slam status --connect tcp/127.0.0.1:7447 --watch")
@click.option("--connect", default="tcp/127.0.0.1:7447", show_default=True, help="Endpoint of the daemon.")
@click.option("--credentials", type=FOLDER, help="Folder with your bundle from `keys issue`, for tls/ endpoints.")
@click.option("--robot", default="rm3", show_default=True, help="The robot's id.")
@click.option("--timeout", default=12.0, show_default=True, help="How long to wait for an answer, s.")
@click.option("--watch", is_flag=True, help="Go on, refreshed in place, until Ctrl+C.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON; with --watch a line for each message.")
def status(connect: str, credentials: Path | None, robot: str, timeout: float, watch: bool, as_json: bool) -> None:
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
        title = f"robominer/{robot}"
        if as_json:
            click.echo(json.dumps(described(entries_of(payload))))
            while watch:
                click.echo(json.dumps(described(entries_of(messages.get()))))
        elif watch:
            _follow(title, payload, messages.get)
        else:
            Console().print(tables(title, entries_of(payload)))


def _follow(title: str, payload: bytes, take: Callable[..., bytes]) -> None:
    """Show each message in the place of the one before, and how old the last one is when nothing more comes."""
    heard = time.monotonic()
    picture = tables(title, entries_of(payload), flat=True)
    # Not in a screen of its own: the last state stays in sight after Ctrl+C.
    with Live(picture, console=Console(), auto_refresh=False) as live:
        while True:
            try:
                payload = take(timeout=WAITING_S)
            except queue.Empty:
                silent_s = time.monotonic() - heard
                live.update(Group(picture, f"last heard {silent_s:.0f} s ago"), refresh=True)
                continue
            heard, picture = time.monotonic(), tables(title, entries_of(payload), flat=True)
            live.update(picture, refresh=True)
