"""`robominer-slam calibrate wizard`: which sensor is which whisker, and how it is mounted; writes the layout file."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.progress import Progress

from robominer_slam import layout as layouts
from robominer_slam.capture.device import WhiskerDevice, load_configuration
from robominer_slam.capture.wizard import Wizard, WizardEvent, found_layout
from robominer_slam.configuration.array import load_layout

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
EPILOG = """
\b
Example: robominer-slam calibrate wizard --config config.toml --plan thesis-grid --out array-07-layout.json
"""


@click.command(epilog=EPILOG)
@click.option("--config", "config_file", type=FILE, required=True, help="Configuration that names the device.")
@click.option("--device", help="Name of the whiskers' device; any that sends frames by default.")
@click.option("--plan", "plan_name", help="Layout with the whiskers' positions; the configuration's by default.")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True, help="Layout file to write.")
@click.option("--name", help="Name of the layout; the output's file name by default.")
@click.option("--frames", default=10, show_default=True, type=click.IntRange(min=3), help="Frames of each bend.")
@click.option("--auto", type=click.FloatRange(min=0.0), help="Go on by itself after so many seconds a bend.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object per line.")
def wizard(
    config_file: Path,
    device: str | None,
    plan_name: str | None,
    out: Path,
    name: str | None,
    frames: int,
    auto: float | None,
    as_json: bool,
) -> None:
    """Find out which sensor is which whisker, and its mount direction; write the layout.

    Bend each whisker as it is asked for, forward and then left (or up, for whiskers on walls), and hold it there.
    """
    configuration, folder = load_configuration(config_file)
    plan = load_layout(plan_name or configuration.robot.layout, folder)
    console = Console(stderr=True)
    with (
        WhiskerDevice(configuration, plan.rows, plan.cols, device=device) as source,
        Progress(console=console, disable=as_json) as progress,
    ):
        task = progress.add_task("whiskers", total=int(plan.present.sum()))

        def tell(event: WizardEvent) -> None:
            if as_json:
                click.echo(json.dumps({key: value for key, value in asdict(event).items() if value is not None}))
                return
            style = {"problem": "bold red", "found": "green"}.get(event.kind, "bold")
            console.print(event.text, style=style, highlight=False)
            if event.kind == "found":
                progress.advance(task)

        found = Wizard(source, plan, tell, frames=frames, auto_s=auto).run()
    if not found:
        raise click.ClickException("no whisker was found: nothing to write")
    layout = found_layout(plan, found, name or out.stem)
    out.write_text(layouts.to_json(layout), encoding="utf-8")
    moved = sum(place != one.sensor for place, one in found.items())
    worst = float(np.rad2deg(max(one.disagreement for one in found.values())))
    summary = {"event": "done", "whiskers": len(found), "elsewhere": moved, "worst_disagreement_deg": worst}
    if as_json:
        click.echo(json.dumps({**summary, "out": str(out)}))
    else:
        click.echo(
            f"{len(found)} of {int(plan.present.sum())} whiskers, {moved} of them on another sensor than planned; "
            f"the two bends of a whisker disagree by {worst:.0f} deg at most; wrote {out}"
        )
