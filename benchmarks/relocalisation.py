"""Relocalisation in a saved map: random starts in the thesis's map, and drives over ground that no map knows.

Usage: python -m benchmarks.relocalisation [--drives N] [--foreign N] [--jobs N] [--source S ...] [--recording FILE ...]

The map is made by replaying the recordings one after the other into one database (the second continues the first).
Each drive starts at a random place and heading of the mapped ground and follows random legs at 0.15 m/s, simulated
quasi-statically; the daemon's pipeline follows it with `start = "localize"`. Confident: the state is tracking and
sigma under 0.1 m. Wrong: off the truth by more than 0.25 m. Nothing may be wrong and confident, at any frame; on
foreign ground every confident frame is wrong.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.random_drives import MappedGround, measurements, random_drive, simulated_robot
from robominer_slam.assembly import build_pipeline
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.replay import ReplayInputs, prepare, replay
from robominer_slam.replay_session import open_session
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.store_reader import load_map
from sim_backend.events import TruthEvent

RECORDINGS = Path(__file__).resolve().parents[1] / "tests" / "recordings"
SOURCES = ("fused", "odometry")
CONFIDENT_M, WRONG_M = 0.1, 0.25
LENGTH_M = 4.0


@dataclass(frozen=True)
class Outcome:
    """One drive.

    Attributes:
        distance: driven until the place was known, m; infinite where it never was.
        error: of the position at that time, m.
        wrong: frames that were confident and wrong.
        frames: frames of the drive.
        search_s: time of the back-end per keyframe, s.
    """

    distance: float
    error: float
    wrong: int
    frames: int
    search_s: float


def make_map(recordings: list[Path], database: Path) -> None:
    """Replay recordings into one map: the first begins it, the others continue it."""
    for path in recordings:
        known = str(database) if database.exists() else None
        inputs, session = open_session(inputs_of(path, "fused"), known, "continue" if known else None, database)
        assert session.store is not None
        with session.store as store:
            replay(
                inputs,
                lambda frame, store=store: [store.add(r, 0) for r in frame.backend_results],
                known=session.known,
                on_rest=lambda result, store=store: store.add(result, 0),
            )


def inputs_of(path: Path, source: str, start: str = "new") -> ReplayInputs:
    """A recording with the method `robust`."""
    inputs = prepare(path, None)
    c = inputs.configuration
    slam = c.slam.model_copy(update={"method": "robust", "start": start})
    estimation = c.estimation.model_copy(update={"source": source})
    return replace(inputs, configuration=c.model_copy(update={"slam": slam, "estimation": estimation}))


@cache
def saved(database: Path) -> tuple[SavedMap, MappedGround]:
    """The newest map, and where its ground is."""
    _, known = load_map(database)
    touched = KeyframeMap(0.01)
    touched.load(known)
    return known, MappedGround(touched.cloud())


def drive(database: Path, recording: Path, world: str, source: str, number: int) -> Outcome:
    """Follow one random drive."""
    known, ground = saved(database)
    inputs = inputs_of(recording, source, "localize")
    pipeline = build_pipeline(inputs.configuration, inputs.layout, inputs.model, "synchronous", known)
    way = random_drive(ground, np.random.default_rng([number, 99]), LENGTH_M)
    truth: dict[int, tuple[np.ndarray, float]] = {}
    last, driven = None, 0.0
    distance, error, wrong, frames, keyframes = np.inf, np.nan, 0, 0, 0
    for item in measurements(simulated_robot(world, way, 100 + number)):
        if isinstance(item, TruthEvent):
            driven += 0.0 if last is None else float(np.hypot(*(item.position - last)[:2]))
            last = item.position
            truth[item.time_ns] = item.position, driven
            continue
        for frame in pipeline.add(*item):
            position, way_m = truth[frame.stamp_ns]
            frames += 1
            keyframes += frame.keyframe is not None
            sigma = float(np.sqrt(np.linalg.eigvalsh(frame.covariance[:2, :2])[-1]))
            if frame.state != "tracking" or sigma >= CONFIDENT_M:
                continue
            off = float(np.hypot(*(frame.T_map_base[:2, 3] - position[:2])))
            if not np.isfinite(distance):
                distance, error = way_m, off
            wrong += off > WRONG_M or world != "thesis"
    assert pipeline.runner is not None
    return Outcome(distance, error, wrong, frames, pipeline.runner.busy_s / max(keyframes, 1))


def main() -> None:
    """Make the map, drive, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=100, help="random drives per source in the thesis's map")
    parser.add_argument("--foreign", type=int, default=20, help="the same on each foreign ground")
    parser.add_argument("--jobs", type=int, default=2, help="drives at the same time")
    parser.add_argument("--recording", type=Path, nargs="+", default=[RECORDINGS / "scenario-5.mcap"])
    parser.add_argument("--source", nargs="+", default=SOURCES, choices=SOURCES, help="of odometry")
    chosen = parser.parse_args()
    table = Table(title="relocalisation")
    for column in ("world", "source", "drives", "known within 1 m", "2 m", "3 m", "never", "wrong and confident",
                   "median way (m)", "median error (m)", "greatest error (m)", "s per search"):  # fmt: skip
        table.add_column(column)
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(chosen.jobs) as pool:
        database = Path(folder) / "map.db"
        make_map(chosen.recording, database)
        known, _ = saved(database)
        print(f"map: {len(known.keyframes)} keyframes, {time.perf_counter() - begin:.0f} s", flush=True)
        for world in ("thesis", "random:2", "corridor"):
            for source in chosen.source:
                count = chosen.drives if world == "thesis" else chosen.foreign
                jobs = [
                    pool.submit(drive, database, chosen.recording[0], world, source, number) for number in range(count)
                ]
                if jobs:
                    table.add_row(world, source, *row([job.result() for job in jobs]))
                    print(f"{world} {source}: {time.perf_counter() - begin:.0f} s", flush=True)
    Console(width=160).print(table)


def row(outcomes: list[Outcome]) -> list[str]:
    """The figures of some drives."""
    way = np.array([one.distance for one in outcomes])
    errors = np.array([one.error for one in outcomes if np.isfinite(one.error)])
    within = [f"{100.0 * float((way <= metres).mean()):.0f} %" for metres in (1.0, 2.0, 3.0)]
    found = [f"{np.median(way):.2f}", f"{np.median(errors):.3f}", f"{errors.max():.3f}"] if len(errors) else ["-"] * 3
    return [
        str(len(outcomes)), *within, str(int(np.isinf(way).sum())), str(sum(one.wrong > 0 for one in outcomes)),
        *found, f"{np.mean([one.search_s for one in outcomes]):.3f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
