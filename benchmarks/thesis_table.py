"""The acceptance table: the thesis's five scenarios with ten odometry noises, other worlds beside them, any methods.

    python -m benchmarks.thesis_table --methods none,thesis --sources fused,odometry --jobs 2 --report table.html
    python -m benchmarks.thesis_table --scenarios 3 --seeds 0-2 --methods none,thesis
    python -m benchmarks.thesis_table --scenarios none --worlds random:1,flooded,flat,corridor --world-scenario 2
    python -m benchmarks.thesis_table --methods thesis --variant "no kernel:slam.thesis.kernel=none"

Recordings with other odometry noise and recordings of other worlds are kept in the cache folder. Runs are saved in
the output folder one by one: an interrupted table goes on where it stopped.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from drivers.recording_reader import Recording, RecordingError
from robominer_slam.cli.evaluation_output import print_campaign, run_with_progress, write_report
from robominer_slam.cli.number_list import number_list
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.overrides import parse_override, parse_variant
from robominer_slam.evaluation.campaign import plan
from robominer_slam.evaluation.height_errors import HeightFunction
from robominer_slam.evaluation.run_record import ResultsError
from sim_backend import world as worlds
from sim_backend.recorded_drive import with_other_odometry
from sim_backend.robot import RobotSettings
from sim_backend.simulate import SimulationSettings, record_drive

ROOT = Path(__file__).resolve().parents[1]


def surface_of(metadata: Mapping[str, str]) -> HeightFunction | None:
    """The true surface of a recording's world; None for worlds with walls, which no height tells."""
    world = worlds.load(metadata["world"])
    return world.height if world.walls is None else None


def redrawn(recording: Path, seed: int, cache: Path) -> Path:
    """The recording with the odometry noise of a seed; itself if it has that one."""
    if Recording(recording).metadata.get("odometry_seed") == str(seed):
        return recording
    made_from = recording.read_bytes() + _simulator()
    out = cache / f"{recording.stem}-{_digest(made_from)}-odometry-{seed}.mcap"
    if not out.exists():
        part = out.with_suffix(".part")
        with_other_odometry(Recording(recording), seed, part)
        part.replace(out)
    return out


def simulated(world: str, scenario: int, cache: Path) -> Path:
    """A recording of a drive in a world by the quasi-static engine, seed 1, odometry seed 0."""
    worlds.load(world).scenario(scenario)
    out = cache / f"{world.replace(':', '-')}-scenario-{scenario}-{_digest(_simulator())}.mcap"
    if not out.exists():
        with tempfile.TemporaryDirectory() as folder:
            settings = SimulationSettings(
                out=Path(folder),
                world=world,
                scenario=scenario,
                engine="quasi-static",
                robot=RobotSettings(seed=1, odometry_seed=0),
                whisker_truth=False,
            )
            part = out.with_suffix(".part")
            record_drive(settings, part)
            part.replace(out)
    return out


def recordings_of(arguments: argparse.Namespace) -> list[Path]:
    """All recordings of the table, made where they are not there yet."""
    arguments.cache.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        made = [
            pool.submit(simulated, world, scenario, arguments.cache)
            for world in arguments.worlds
            for scenario in arguments.world_scenario
        ]
        base = [arguments.recordings / f"scenario-{number}.mcap" for number in arguments.scenarios]
        base += [job.result() for job in made]
        if "odometry" not in arguments.sources:
            return base
        jobs = [pool.submit(redrawn, path, seed, arguments.cache) for path in base for seed in arguments.seeds]
        # The fused odometry is replayed on the first of each drive.
        return [job.result() for job in jobs]


def _simulator() -> bytes:
    """The simulator's own code: what another one has made is not taken."""
    return b"".join(path.read_bytes() for path in sorted((ROOT / "sim_backend").glob("*.py")))


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:8]


def _names(text: str) -> list[str]:
    return [] if text == "none" else [name.strip() for name in text.split(",") if name.strip()]


def _numbers(text: str) -> list[int]:
    return [] if text == "none" else number_list(text)


def arguments_of(command_line: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", type=lambda text: text.split(","), default=["none", "thesis"])
    parser.add_argument("--sources", type=_names, default=["fused", "odometry"])
    parser.add_argument("--scenarios", type=_numbers, default=[1, 2, 3, 4, 5], help="of the thesis, or none")
    parser.add_argument("--seeds", type=number_list, default=list(range(10)), help="of the ready-made odometry")
    parser.add_argument("--worlds", type=_names, default=[], help="others, as random:1,flooded,flat,corridor")
    parser.add_argument("--world-scenario", type=number_list, default=[2], help="driven in the other worlds")
    parser.add_argument("--set", type=parse_override, action="append", default=[], dest="common", metavar="KEY=VALUE")
    parser.add_argument("--variant", type=parse_variant, action="append", default=[], metavar="LABEL:KEY=VALUE,...")
    parser.add_argument("--recordings", type=Path, default=ROOT / "tests" / "recordings")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "recordings")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "thesis-table", help="folder of the results")
    parser.add_argument("--report", type=Path, help="HTML file to write")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true", dest="as_json")
    return parser.parse_args(command_line)


def main() -> None:
    arguments = arguments_of()
    try:
        recordings = recordings_of(arguments)
        tasks = plan(recordings, arguments.methods, arguments.sources, arguments.variant, arguments.common)
    except (ConfigurationError, RecordingError, ResultsError, worlds.WorldError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    try:
        campaign = run_with_progress(tasks, arguments.out, arguments.jobs, surface_of)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        sys.exit(130)
    if arguments.report is not None and campaign.records:
        write_report(arguments.report, campaign.records, campaign.files)
    print_campaign(campaign, arguments.out, arguments.as_json)
    sys.exit(1 if campaign.failures else 0)


if __name__ == "__main__":
    main()
