"""The thesis's five scenarios as recordings, packed tight: what tests and replays start from.

Usage: python -m benchmarks.make_recordings [--out FOLDER] [--jobs N] [--scenario N ...]

Physics engine, seed 1, odometry seed 0, without whisker truth. Prints a Markdown table. The same code makes the same
files, byte for byte.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from drivers.recording_reader import Recording
from sim_backend.robot import RobotSettings
from sim_backend.simulate import SimulationSettings, record_drive

ROOT = Path(__file__).resolve().parents[1]
#: Longest first, so that the last job is a short one.
SCENARIOS = (5, 4, 3, 1, 2)


def make(scenario: int, out: Path) -> float:
    """Record one scenario; returns the seconds it took."""
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        settings = SimulationSettings(
            out=Path(folder),
            scenario=scenario,
            robot=RobotSettings(seed=1, odometry_seed=0),
            whisker_truth=False,
            compact=True,
        )
        record_drive(settings, path_of(scenario, out))
    return time.perf_counter() - begin


def path_of(scenario: int, out: Path) -> Path:
    """Where a scenario's recording lies."""
    return out / f"scenario-{scenario}.mcap"


def main() -> None:
    """Make them, and print what they are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "tests" / "recordings", help="folder; made if absent")
    parser.add_argument("--jobs", type=int, default=2, help="scenarios at the same time")
    parser.add_argument("--scenario", type=int, nargs="+", default=SCENARIOS, choices=SCENARIOS)
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    print("| scenario | duration (s) | messages | size (MB) | made in (s) |\n|---|---|---|---|---|", flush=True)
    total = 0
    with ProcessPoolExecutor(chosen.jobs) as pool:
        jobs = {pool.submit(make, scenario, chosen.out): scenario for scenario in chosen.scenario}
        for job in as_completed(jobs):
            scenario, seconds = jobs[job], job.result()
            path = path_of(scenario, chosen.out)
            recording, size = Recording(path), path.stat().st_size
            total += size
            duration = recording.duration_ns * 1e-9
            print(
                f"| {scenario} | {duration:.1f} | {recording.message_count} | {size / 1e6:.2f} | {seconds:.0f} |",
                flush=True,
            )
    print(f"\ntogether {total / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
