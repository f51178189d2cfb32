"""Whisker health on recorded and simulated drives: false alarms, time to find each fault, contacts made by flow.

Usage: python -m benchmarks.health [--seeds N]

False alarms are counted on the healthy recordings of tests/recordings; faults are laid over scenario 1 by the
simulator's own fault model, on three whiskers and seeds; flow is measured in world `flooded`, where the truth knows
which whiskers touch.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import AngleEstimator
from calibration.polynomial import PolynomialModel
from drivers.measurement import HallFrame
from robominer_slam.configuration.model import HealthSection
from robominer_slam.frame_result import FrameResult
from robominer_slam.layout import thesis_grid
from robominer_slam.replay import prepare, replay
from robominer_slam.whisker_health import WhiskerHealth, WhiskerState
from sim_backend.events import WhiskerEvent
from sim_backend.fault_schedule import Fault
from sim_backend.robot import RobotSettings
from sim_backend.sensor_faults import SensorFaults
from sim_backend.simulate import SimulationSettings, record_drive

RECORDINGS = Path("tests/recordings")
KINDS = ("whisker_dead", "whisker_stuck", "whisker_noisy", "whisker_flipped", "whisker_broken", "whisker_bus_error")
START, END = 8.0, 40.0
FRAME_RATE = 25.0
WHISKERS = ((3, 4), (0, 1), (6, 7))


@dataclass(frozen=True)
class Frames:
    """Whisker frames of a recording, its calibration, and where the robot was, shape (n, 2), m."""

    recording: Path
    model: PolynomialModel
    frames: list[HallFrame]
    position: NDArray[np.float64]


def read(path: Path, seconds: float | None = None) -> Frames:
    """Frames of a recording with true positions, as odometry would give them within millimetres over a second."""
    inputs = prepare(path, None)
    frames = [m for _, m in inputs.recording if isinstance(m, HallFrame)]
    if seconds is not None:
        frames = frames[: round(seconds * FRAME_RATE)]
    truth = [t for _, t in inputs.recording.ground_truth()]
    stamps, poses = [t.stamp_ns for t in truth], np.array([t.pose[:2] for t in truth])
    when = [frame.stamp_ns for frame in frames]
    position = np.column_stack([np.interp(when, stamps, poses[:, axis]) for axis in (0, 1)])
    return Frames(path, inputs.model, frames, position)


def states(drive: Frames, fault: Fault | None = None, seed: int = 0) -> NDArray[np.int8]:
    """State of every whisker after every frame, shape (frames, n)."""
    model, layout = drive.model, thesis_grid()
    first = drive.frames[0].stamp_ns
    events = (
        WhiskerEvent(f.stamp_ns - first, f.stamp_ns, f.field_mT.reshape(-1, 3), f.valid.reshape(-1), None)
        for f in drive.frames
    )
    estimator = AngleEstimator(model)
    health = WhiskerHealth(HealthSection(), layout, model.rest_mT, model.fitted, folded=False)
    found = []
    for k, event in enumerate(SensorFaults([fault] if fault else [], model.rest_mT, cols=8, seed=seed).apply(events)):
        angles = estimator.angles(event.field_mT, event.valid)
        x, y = drive.position[k]
        health.update(event.time_ns, event.field_mT, event.valid, angles.inclination, angles.azimuth, (x, y))
        found.append(health.state.copy())
    return np.array(found)


def print_false_alarms() -> None:
    print("| recording | whisker-seconds | wrongly out (whisker-seconds) | states |\n|---|---|---|---|")
    for path in sorted(RECORDINGS.glob("scenario-*.mcap")):
        found = states(read(path))
        out = found[found != WhiskerState.OK]
        names = ", ".join(WhiskerState(int(s)).name.lower() for s in np.unique(out)) or "-"
        print(f"| {path.stem} | {found.size / FRAME_RATE:.0f} | {len(out) / FRAME_RATE:.1f} | {names} |", flush=True)


def print_delays(seeds: int) -> None:
    drive = read(RECORDINGS / "scenario-1.mcap", 48.0)
    print("\n| fault | found after: median / worst (s) | back after its end (s) | others accused |\n|---|---|---|---|")
    for kind in KINDS:
        found, back, others = [], [], 0
        for seed in range(seeds):
            for row, col in WHISKERS:
                index = 8 * row + col
                state = states(drive, Fault(kind, START, END, (row, col)), seed)
                own = state[:, index] != WhiskerState.OK
                hit = np.flatnonzero(own[round(START * FRAME_RATE) :])
                found.append(hit[0] / FRAME_RATE if len(hit) else np.inf)
                well = np.flatnonzero(~own[round(END * FRAME_RATE) :])
                back.append(well[0] / FRAME_RATE if len(well) else np.inf)
                others += int((np.delete(state, index, axis=1) != WhiskerState.OK).any(axis=0).sum())
        name = kind.removeprefix("whisker_")
        print(f"| {name} | {np.median(found):.2f} / {max(found):.2f} | {np.median(back):.2f} | {others} |", flush=True)


def print_flow(seconds: float) -> None:
    print("\n| world | what is a contact | false of all contacts | true ones kept |\n|---|---|---|---|")
    for world in ("flooded", "flooded:1", "thesis"):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "drive.mcap"
            settings = SimulationSettings(
                Path(folder), world=world, engine="quasi-static", robot=RobotSettings(max_time=seconds)
            )
            record_drive(settings, path)
            inputs = prepare(path, None)
            touching = [t.contact for _, t in inputs.recording.whisker_truth()]
            limit = inputs.configuration.contact.min_inclination_deg
            kept: list[NDArray[np.bool_]] = []
            bent: list[NDArray[np.bool_]] = []

            def note(result: FrameResult, bent: list = bent, kept: list = kept, limit: float = limit) -> None:
                bent.append(result.angles.valid & (result.angles.inclination >= np.deg2rad(limit)))
                kept.append(np.isin(np.arange(len(result.angles.valid)), result.contacts.index))

            replay(inputs, note)
        truth = np.array(touching)[: len(kept)]
        for label, said in (("inclination alone", np.array(bent)), ("told from flow", np.array(kept))):
            false = np.count_nonzero(said & ~truth) / max(np.count_nonzero(said), 1)
            true = np.count_nonzero(said & truth) / max(np.count_nonzero(truth & np.array(bent)), 1)
            print(f"| {world} | {label} | {100 * false:.1f} % | {100 * true:.1f} % |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=90.0, help="of flooded drives")
    args = parser.parse_args()
    print_false_alarms()
    print_delays(args.seeds)
    print_flow(args.seconds)


if __name__ == "__main__":
    main()
