"""`robominer-slam demo`: command line; the work is in `demo.py`."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(epilog="Example: robominer-slam demo --out out --scenario 1")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("out"), show_default=True,
              help="Folder for figures, trajectories, report and logs.")  # fmt: skip
@click.option("--scenario", type=click.IntRange(1, 5), default=1, show_default=True, help="Of the thesis.")
@click.option("--seed", default=1, show_default=True, help="Tolerances, biases, noise and slip of all sensors.")
@click.option("--method", type=click.Choice(["robust", "thesis", "none"]), default="robust", show_default=True,
              help="SLAM method; none gives exactly the odometry.")  # fmt: skip
@click.option("--max-time", type=click.FloatRange(min=5.0), help="Cut the drive short, s.")
@click.option("--operator-port", type=click.IntRange(0, 65535), default=8080, show_default=True,
              help="Port of the operator's console; another where it is taken.")  # fmt: skip
@click.option("--no-operator", is_flag=True, help="Without the operator's console.")
@click.option("--record", is_flag=True, help="Also write the drive as OUT/drive.mcap, for replay.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def demo(
    out: Path,
    scenario: int,
    seed: int,
    method: str,
    max_time: float | None,
    operator_port: int,
    no_operator: bool,
    record: bool,
    as_json: bool,
) -> None:
    """A simulated robot, the daemon, a listener and the operator's console, each a process; then the report.

    Takes as long as the scenario: two and a half minutes for scenario 1.
    """
    from sim_backend.demo import DemoSettings, run_demo  # matplotlib and rich: not for --help

    out.mkdir(parents=True, exist_ok=True)
    port = None if no_operator else operator_port
    run_demo(DemoSettings(out, scenario, seed, method, max_time, record, as_json, port))
