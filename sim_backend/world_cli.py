"""`robominer-slam world`: what a simulated world is, in figures and in pictures."""

from __future__ import annotations

import json
from pathlib import Path

import click
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

EPILOG = """
\b
Example: what the mine is; a picture of the robot in it; an animation of a whole scenario:
  robominer-slam world mine
  robominer-slam world mine --at 60 --picture mine.png
  robominer-slam world thesis --scenario 4 --picture scenario4.webp
"""


@click.command(epilog=EPILOG)
@click.argument("name", default="thesis")
@click.option("--scenario", default=1, show_default=True, help="Scenario of the picture.")
@click.option("--engine", type=click.Choice(["physics", "quasi-static"]), default="quasi-static", show_default=True,
              help="What moves the whiskers in the picture.")  # fmt: skip
@click.option("--at", default=15.0, show_default=True, help="Time of the picture in the scenario, s.")
@click.option("--picture", type=click.Path(dir_okay=False, path_type=Path),
              help="Write the robot in the world: FILE.png, FILE.webp or .gif for the whole scenario.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def world(name: str, scenario: int, engine: str, at: float, picture: Path | None, as_json: bool) -> None:
    """Show a world of the simulated robot: its layout, size and scenarios; with --picture, how it looks."""
    # MuJoCo and matplotlib take a second to import: not for --help.
    from sim_backend import world as worlds
    from sim_backend.waypoints import WaypointPath
    from sim_backend.world_picture import write_animation, write_picture

    try:
        scene = worlds.load(name)
        paths = {number: WaypointPath(waypoints) for number, waypoints in scene.scenarios.items()}
        figures = {
            "name": scene.name,
            "layout": scene.layout,
            "objects": [solid.name for solid in scene.solids],
            "scenarios": {
                number: {"length_m": round(path.length, 2), "duration_s": round(path.duration, 1)}
                for number, path in paths.items()
            },
        }
        if picture is not None:
            duration = paths[scenario].duration if scenario in paths else 0.0
            if picture.suffix not in (".png", ".gif", ".webp"):
                raise click.UsageError(f"--picture {picture}: expected a file that ends in .png, .webp or .gif")
            if scenario in paths and not 0.0 <= at <= duration:
                raise click.UsageError(f"--at {at:g}: scenario {scenario} lasts from 0 to {duration:.0f} s")
            if picture.suffix == ".png":
                write_picture(scene, scenario, engine, at, picture)
            else:
                with Progress(console=Console(stderr=True), transient=True) as progress:
                    task = progress.add_task("drawing", total=1.0)
                    write_animation(
                        scene,
                        scenario,
                        engine,
                        picture,
                        on_progress=lambda share: progress.update(task, completed=share),
                    )
    except (worlds.WorldError, OSError) as error:
        raise click.UsageError(str(error)) from error
    if as_json:
        click.echo(json.dumps(figures))
        return
    table = Table("scenario", "length (m)", "duration (s)", title=f"world {scene.name}, layout {scene.layout}")
    for number, path in paths.items():
        table.add_row(str(number), f"{path.length:.1f}", f"{path.duration:.0f}")
    Console().print(table)
    if scene.solids:
        click.echo("objects: " + ", ".join(solid.name for solid in scene.solids))
