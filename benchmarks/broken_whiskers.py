"""What is left when a quarter of the whiskers is dead or stuck, against the healthy array on the same drives.

    python -m benchmarks.broken_whiskers [--scenarios 1-5] [--worlds thesis,random:3] [--draws 0-1] [--jobs 2]

The quasi-static engine drives each scenario twice with the same seeds: once healthy, once with 16 of the 64 whiskers
broken from the start, drawn anew for each draw, half of them dead (a field that reads zero) and half of them stuck.
The program is not told which: its own health checks have to find them.
"""

from __future__ import annotations

import argparse
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.thesis_table import surface_of
from robominer_slam.cli.number_list import number_list
from robominer_slam.evaluation.run_record import RunKey, RunRecord
from robominer_slam.evaluation.run_task import RunTask, evaluate_run
from sim_backend.robot import RobotSettings
from sim_backend.simulate import SimulationSettings, record_drive

ROWS = COLUMNS = 8
#: A quarter of the array.
BROKEN = 16
#: Error of the broken array over that of the healthy one that the project asks for.
ALLOWED = 1.5


def fault_file(draw: int, folder: Path) -> Path:
    """A file of faults for the simulator: half of `BROKEN` whiskers dead, half stuck, from the start."""
    places = np.random.default_rng(draw).permutation(ROWS * COLUMNS)[:BROKEN]
    path = folder / f"faults-{draw}.toml"
    path.write_text(
        "".join(
            f'[[fault]]\nkind = "whisker_{"dead" if k % 2 else "stuck"}"\n'
            f"row = {place // COLUMNS}\ncol = {place % COLUMNS}\nstart = 0.0\n\n"
            for k, place in enumerate(places)
        )
    )
    return path


def errors(world: str, scenario: int, draw: int | None, sources: tuple[str, ...]) -> list[RunRecord]:
    """A drive simulated and replayed with each source of odometry; no draw: a healthy array."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        settings = SimulationSettings(
            out=folder,
            world=world,
            scenario=scenario,
            engine="quasi-static",
            robot=RobotSettings(seed=1, odometry_seed=0),
            faults=None if draw is None else str(fault_file(draw, folder)),
            whisker_truth=False,
        )
        recording = folder / f"scenario-{scenario}.mcap"
        record_drive(settings, recording)
        keys = [RunKey(recording.stem, None, "robust", source) for source in sources]
        return [evaluate_run(RunTask(recording, key), surface_of).record for key in keys]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=lambda text: text.split(","), default=["thesis"])
    parser.add_argument("--scenarios", type=number_list, default=[1, 2, 3, 4, 5])
    parser.add_argument("--draws", type=number_list, default=[0, 1])
    parser.add_argument("--sources", type=lambda text: tuple(text.split(",")), default=("fused", "odometry"))
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    arrays = [None, *arguments.draws]
    drives = [(world, scenario) for world in arguments.worlds for scenario in arguments.scenarios]
    print(f"{'drive':<16} {'odometry':<9} {'healthy m':>9} " + " ".join(f"{f'draw {d}':>9}" for d in arguments.draws))
    sums = {source: np.zeros(len(arrays)) for source in arguments.sources}
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        jobs = {drive: [pool.submit(errors, *drive, draw, arguments.sources) for draw in arrays] for drive in drives}
        for (world, scenario), runs in jobs.items():
            records = [run.result() for run in runs]
            for k, source in enumerate(arguments.sources):
                means = np.array([record[k].slam_position_m.mean for record in records])
                sums[source] += means / len(drives)
                wrong = sum(record[k].closures.wrong for record in records)
                figures = " ".join(f"{mean:>9.3f}" for mean in means)
                print(f"{f'{world} {scenario}':<16} {source:<9} {figures}   wrong closures {wrong}", flush=True)
    for source, means in sums.items():
        ratios = means[1:] / means[0]
        verdict = "met" if ratios.max() <= ALLOWED else "MISSED"
        figures = " ".join(f"{mean:>9.3f}" for mean in means)
        print(f"{'mean':<16} {source:<9} {figures}   worst ratio {ratios.max():.2f} ({ALLOWED} allowed: {verdict})")


if __name__ == "__main__":
    main()
