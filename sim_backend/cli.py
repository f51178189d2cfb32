"""`robominer-slam simulate`: command line of the simulated robot; the work is in `simulate.py`."""

from __future__ import annotations

import json
import logging
import sys
from dataclasses import asdict, replace
from pathlib import Path

import click

EPILOG = """
\b
Example: drive scenario 1, and run the daemon on it in another terminal:
  robominer-slam simulate --scenario 1 --out out/sim
  robominer-slam run --config out/sim/config.toml
\b
A recording instead, as fast as it goes; the same with another odometry; and served on ports:
  robominer-slam simulate --scenario 3 --out out/sim --record drive.mcap
  robominer-slam simulate --from drive.mcap --odometry-seed 7 --out drive7.mcap
  robominer-slam simulate --from drive7.mcap --source odometry --out out/again
"""


@click.command(epilog=EPILOG)
@click.option(
    "--world",
    default="thesis",
    show_default=True,
    help="World to drive in: thesis, random:SEED, flat, corridor, flooded, flooded:SEED; for the rm3 layout tunnel, "
    "mine or mine:SEED:METRES.",
)
@click.option("--scenario", default=1, show_default=True, help="Scenario of the world, 1 to 5; 0 waits for waypoints.")
@click.option(
    "--engine",
    type=click.Choice(["physics", "quasi-static"]),
    default="physics",
    show_default=True,
    help="What moves the whiskers: MuJoCo, or geometry alone, which is many times faster.",
)
@click.option(
    "--joint",
    type=click.Choice(["default", "thesis-literal"]),
    default="default",
    show_default=True,
    help="The whiskers' joints: as the thesis measured them, or with its stiffness read as 5.7 N m/rad.",
)
@click.option("--seed", default=1, show_default=True, help="Tolerances, biases, noise and slip of all sensors.")
@click.option("--odometry-seed", type=int, help="Bias and noise of the ready-made odometry.  [default: 0]")
@click.option(
    "--odometry-grade",
    type=click.Choice(["thesis", "half", "double"]),
    default="thesis",
    show_default=True,
    help="Size of the ready-made odometry's bias and noise.",
)
@click.option(
    "--imu", type=click.Choice(["bno080", "3dm-cv7"]), default="bno080", show_default=True, help="Grade of the IMU."
)
@click.option("--imu-mount", type=(float, float, float), default=(0.0, 0.0, 0.0), help="Roll, pitch, yaw, deg.")
@click.option(
    "--from",
    "source_file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Serve a recording instead of simulating; with --odometry-seed and --out FILE.mcap, write it anew.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("out/sim"),
    show_default=True,
    help="Folder for ports, configuration, calibration and ground truth; with --from and --odometry-seed a file.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0.05, 20.0),
    default=1.0,
    show_default=True,
    help="Simulated seconds per second; the devices then show a robot that drives so many times as fast.",
)
@click.option(
    "--source",
    type=click.Choice(["fused", "odometry"]),
    default="fused",
    show_default=True,
    help="Odometry in the configuration: IMU and screws, or the ready-made one.",
)
@click.option("--method", default=None, help="SLAM method in the configuration (default: the daemon's).")
@click.option("--listen", default="tcp/127.0.0.1:7447", show_default=True, help="Zenoh endpoint in the configuration.")
@click.option(
    "--zenoh-waypoints", is_flag=True, help="Also take waypoints over Zenoh, from an operator's console at --listen."
)
@click.option(
    "--protocol",
    "protocols",
    multiple=True,
    help="What a device speaks, as whiskers=rm3-compressed; framed by default; repeat for several.",
)
@click.option("--faults", help="What goes wrong: a TOML file of [[fault]] tables, or seed:N.")
@click.option("--max-time", type=click.FloatRange(min=0.1), default=None, help="Cut the drive short, s.")
@click.option(
    "--wait",
    type=click.FloatRange(0.0),
    default=60.0,
    show_default=True,
    help="Drive off without a reader after so many seconds.",
)
@click.option(
    "--record",
    "recording",
    type=click.Path(dir_okay=False, path_type=Path),
    default=None,
    help="Write an MCAP recording instead of serving ports.",
)
@click.option("--no-whisker-truth", is_flag=True, help="With --record: leave out what the whiskers really did.")
@click.option("--compact", is_flag=True, help="With --record: pack the file tighter, which takes longer.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line.")
def simulate(
    world: str,
    scenario: int,
    engine: str,
    joint: str,
    seed: int,
    odometry_seed: int | None,
    odometry_grade: str,
    imu: str,
    imu_mount: tuple[float, float, float],
    source_file: Path | None,
    out: Path,
    rate: float,
    source: str,
    method: str | None,
    listen: str,
    zenoh_waypoints: bool,
    protocols: tuple[str, ...],
    faults: str | None,
    max_time: float | None,
    wait: float,
    recording: Path | None,
    no_whisker_truth: bool,
    compact: bool,
    as_json: bool,
) -> None:
    """The simulated robot: drives a scenario and serves its devices on pseudo-terminals.

    It stands still until the ports are read (or --wait is over), then for two more seconds, drives, and ends.
    """
    # MuJoCo and magpylib take a second to import: not for --help.
    from drivers.recording_reader import Recording
    from sim_backend import imu as imus
    from sim_backend import odometry as odometries
    from sim_backend import simulate as simulation
    from sim_backend.device_protocols import ProtocolError
    from sim_backend.fault_schedule import FaultFileError
    from sim_backend.recorded_drive import RecordedDriveError, with_other_odometry
    from sim_backend.recording_progress import progress_bar
    from sim_backend.robot import RobotSettings
    from sim_backend.world import WorldError

    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    settings = simulation.SimulationSettings(
        out=out,
        world=world,
        scenario=scenario,
        engine=engine,
        robot=RobotSettings(
            seed=seed,
            odometry_seed=odometry_seed or 0,
            joint=joint,
            max_time=max_time,
            imu=replace(imus.GRADES[imu], mount_rpy_deg=imu_mount),
            odometry=odometries.GRADES[odometry_grade],
        ),
        rate=rate,
        wait=wait,
        source=source,
        method=method,
        listen=listen,
        zenoh_waypoints=zenoh_waypoints,
        protocols=protocols,
        faults=faults,
        whisker_truth=not no_whisker_truth,
        compact=compact,
    )

    def ready(report: simulation.ReadyReport) -> None:
        if as_json:
            _print_json({"event": "ready", **asdict(report)})
            return
        for name, port in report.ports.items():
            click.echo(f"{name:10s} {port}")
        click.echo(f"configuration: {report.configuration}")
        click.echo(f"ground truth:  {report.truth}")
        if report.duration is None:
            click.echo(f"waits for waypoints: robominer-slam waypoint X Y HEADING_DEG --out {out}")
            return
        driven = source_file.name if source_file is not None else f"scenario {scenario}"
        click.echo(f"{driven}: {report.length:.1f} m in {report.duration / rate:.0f} s")

    try:
        if source_file is not None and odometry_seed is not None:
            if out.suffix != ".mcap":
                raise click.UsageError(f"--out {out}: with --from and --odometry-seed expected a file, FILE.mcap")
            samples = with_other_odometry(Recording(source_file), odometry_seed, out)
            if as_json:
                _print_json({"event": "recorded", "file": out, "messages": {"odometry/twist": samples}})
            else:
                click.echo(f"{out}: {source_file} with {samples} odometry samples of seed {odometry_seed}")
            return
        if recording is not None:
            with progress_bar(f"recording {recording.name}") as on_progress:
                counts = simulation.record_drive(settings, recording, on_progress)
            if as_json:
                _print_json({"event": "recorded", "file": recording, "messages": counts})
            else:
                click.echo(f"{recording}: " + ", ".join(f"{n} on {topic}" for topic, n in counts.items()))
            return
        if source_file is not None:
            out.mkdir(parents=True, exist_ok=True)
            drive = simulation.recorded_drive(source_file, settings.robot.screws.ticks_per_turn)
        else:
            drive = simulation.simulated_drive(settings)
        report = simulation.serve(settings, drive, ready)
    except (WorldError, RecordedDriveError, ProtocolError, FaultFileError, OSError) as error:
        raise click.UsageError(str(error)) from error
    if as_json:
        _print_json({"event": "done", **asdict(report)})
    else:
        packets = ", ".join(f"{name} {n} ({report.dropped[name]} dropped)" for name, n in report.sent.items())
        click.echo(f"{'stopped' if report.stopped else 'driven'} after {report.seconds:.1f} s; packets: {packets}")


def _print_json(values: dict[str, object]) -> None:
    click.echo(json.dumps(values, default=str))
    sys.stdout.flush()
