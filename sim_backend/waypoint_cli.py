"""`robominer-slam waypoint`: sends a running simulation on."""

from __future__ import annotations

import json
from pathlib import Path

import click

from sim_backend.control_socket import NoSimulationError, ask

EPILOG = """
\b
Example: a robot that waits for waypoints, two of them, and the end after the second:
  robominer-slam simulate --scenario 0 --out out/sim
  robominer-slam waypoint 1.2 0.3 90 --out out/sim
  robominer-slam waypoint 0 0 -90 --end --out out/sim
"""


class WaypointError(click.ClickException):
    """A waypoint that was not taken."""

    exit_code = 2


# Otherwise negative numbers would be taken for options.
@click.command(epilog=EPILOG, context_settings={"ignore_unknown_options": True})
@click.argument("waypoint", nargs=-1, type=float, metavar="[X Y HEADING_DEG]")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out/sim"), show_default=True, help="Simulation's folder."
)
@click.option("--end", is_flag=True, help="End the drive when all waypoints have been driven.")
def waypoint(waypoint: tuple[float, ...], out: Path, end: bool) -> None:
    """Append a waypoint, in m and deg in the map, to what a running simulation drives.

    The robot drives straight there while it turns the shorter way round, and waits for the next one.
    """
    if len(waypoint) != 3 and (waypoint or not end):
        raise WaypointError(f"expected X Y HEADING_DEG or --end, found {len(waypoint)} numbers")
    if waypoint:
        reply = _ask(out, {"add_waypoint": list(waypoint)})
        click.echo(f"driven from {reply['starts_s']:.1f} s to {reply['arrives_s']:.1f} s of simulated time")
    if end:
        click.echo(f"the drive ends at {_ask(out, {'end': True})['ends_s']:.1f} s of simulated time")


def _ask(folder: Path, request: dict[str, object]) -> dict[str, float]:
    try:
        reply: dict[str, float] = json.loads(ask(folder, json.dumps(request).encode()))
    except NoSimulationError as error:
        raise WaypointError(str(error)) from error
    if "error" in reply:
        raise WaypointError(str(reply["error"]))
    return reply
