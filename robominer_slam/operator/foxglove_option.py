"""`--foxglove` of `robominer-slam operator`: the console's session, shown to a Foxglove viewer as well."""

from __future__ import annotations

import contextlib
import sys
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from robominer_slam.publishing.zenoh_session import ZenohBus

#: Foxglove's own default.
PORT = 8765

foxglove_option = click.option(
    "--foxglove",
    "foxglove_port",
    type=click.IntRange(0, 65535),
    is_flag=False,
    flag_value=PORT,
    metavar="[PORT]",
    help=f"Serve the Foxglove viewer too, on this machine, on this port ({PORT}); 0: any free one.",
)


def show_in_foxglove(stack: contextlib.ExitStack, bus: ZenohBus, port: int | None) -> None:
    """Serve until the stack is closed, and say where; without a port nothing happens.

    Raises:
        ConfigurationError: foxglove-sdk is missing, or the port is taken.
    """
    if port is None:
        return
    # Imported here, as only who wants it has it.
    from robominer_slam.operator.foxglove_bridge import HOST, FoxgloveBridge

    bridge = stack.enter_context(FoxgloveBridge(bus, port))
    click.echo(f"Foxglove: ws://{HOST}:{bridge.port}")
    sys.stdout.flush()
