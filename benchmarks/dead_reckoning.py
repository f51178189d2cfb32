"""Dead reckoning against the truth: old and new, both sources, with and without the drag of the whiskers.

Usage: python -m benchmarks.dead_reckoning [--worlds thesis flat ...] [--seeds N] [--max-time S]

Runs on the recordings in tests/recordings and on worlds simulated by the quasi-static engine. The ready-made odometry
is redrawn for each odometry seed, and its figures are means over the seeds. Prints a Markdown table: mean and final
position error, mean heading error, length of the way (chords of 0.5 m) against the true one, CPU time per frame.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import AngleEstimator
from drivers.measurement import HallFrame, Measurement, OdometrySample
from drivers.recording_reader import Recording
from robominer_slam import geometry
from robominer_slam.assembly import build_robust_odometry
from robominer_slam.configuration.model import Configuration
from robominer_slam.contacts import ContactModel, Contacts, at_frame_start
from robominer_slam.estimation.fused_odometry import FusedOdometry
from robominer_slam.estimation.integrated_odometry import IntegratedOdometry
from robominer_slam.estimation.odometry_state import DeadReckoning, FeelsMotion
from robominer_slam.estimation.screw_kinematics import forward_matrix
from robominer_slam.evaluation.trajectory import Trajectory, interpolate
from robominer_slam.layout import WhiskerLayout
from robominer_slam.reorder import ReorderBuffer
from robominer_slam.replay import prepare
from sim_backend.base_motion import BaseStates
from sim_backend.odometry import BiasedOdometry
from sim_backend.robot import RobotSettings
from sim_backend.simulate import SimulationSettings, record_drive

FloatArray = NDArray[np.float64]

RECORDINGS = Path(__file__).resolve().parents[1] / "tests" / "recordings"
WORLDS = ("thesis", "random:1", "random:2", "random:3", "random:4", "flat", "corridor", "tunnel", "mine")
CHORD = 0.5
METHODS = ("integrated", "odometry", "odometry + drag", "old fused", "fused", "fused + drag")


@dataclass(frozen=True)
class Frame:
    """A whisker frame reduced to its contacts."""

    stamp_ns: int
    sensor_period_ns: int
    contacts: Contacts


@dataclass(frozen=True)
class Drive:
    """A recording reduced to what dead reckoning sees, and the truth."""

    configuration: Configuration
    layout: WhiskerLayout
    events: list[Frame | Measurement]
    truth: Trajectory


def load(path: Path) -> Drive:
    inputs = prepare(path, None)
    angles, contact = AngleEstimator(inputs.model), inputs.configuration.contact
    model = ContactModel(
        inputs.layout, math.radians(contact.min_inclination_deg), math.radians(contact.max_inclination_deg)
    )
    reorder = ReorderBuffer(500_000_000)
    due: list[tuple[str, Measurement]] = []
    for _, measurement in inputs.recording:
        due += reorder.add("", measurement)
    events: list[Frame | Measurement] = []
    for _, measurement in due + reorder.flush():
        if isinstance(measurement, HallFrame):
            found = angles.angles(measurement.field_mT, measurement.valid)
            contacts = model.contacts(found, found.valid)
            events.append(Frame(measurement.stamp_ns, measurement.sensor_period_ns, contacts))
        else:
            events.append(measurement)
    truths = [truth for _, truth in Recording(path).ground_truth()]
    truth = Trajectory(
        np.array([t.stamp_ns for t in truths], dtype=np.int64),
        geometry.from_vector7(np.array([t.pose for t in truths])),
    )
    return Drive(inputs.configuration, inputs.layout, events, truth)


def with_odometry(drive: Drive, seed: int) -> list[Frame | Measurement]:
    """The drive's events with the ready-made odometry of another seed."""
    stamps = [e.stamp_ns for e in drive.events if isinstance(e, OdometrySample)]
    odometry = BiasedOdometry(seed)
    before = stamps[0] - round(1e9 / odometry.settings.rate)
    own = drive.truth.stamps_ns
    _, T = interpolate(drive.truth, np.clip(np.array([before, *stamps], dtype=np.int64), own[0], own[-1]))
    still = np.zeros((len(T), 3))
    drawn = iter(odometry.sample(BaseStates(T[:, :3, 3], T[:, :3, :3], still, still, still, still)))
    return [OdometrySample(e.stamp_ns, next(drawn)) if isinstance(e, OdometrySample) else e for e in drive.events]


def dead_reckoning(method: str, drive: Drive) -> DeadReckoning:
    configuration = drive.configuration
    if method == "integrated":
        return IntegratedOdometry()
    if method == "old fused":
        screws = configuration.screws
        matrix = forward_matrix(screws.radius, np.deg2rad(screws.helix_angle_deg), screws.half_track, screws.half_base)
        return FusedOdometry(configuration.estimation, matrix)
    source, _, drag = method.partition(" + ")
    settings = configuration.model_copy(
        update={
            "estimation": configuration.estimation.model_copy(update={"source": source}),
            "robust_estimation": configuration.robust_estimation.model_copy(update={"drag": bool(drag)}),
        }
    )
    return build_robust_odometry(settings, drive.layout)


def run(method: str, drive: Drive, events: list[Frame | Measurement]) -> tuple[float, ...]:
    """Mean and final position error (m), mean heading error (deg), length's error (%), CPU time a frame (ms)."""
    odometry = dead_reckoning(method, drive)
    poses, stamps, cpu = [], [], 0.0
    begin = time.process_time()
    for event in events:
        if not isinstance(event, Frame):
            odometry.add(event)
            continue
        state = odometry.state_at(event.stamp_ns)
        if isinstance(odometry, FeelsMotion):
            odometry.add_contacts(
                event.stamp_ns, at_frame_start(event.contacts, state.velocity, event.sensor_period_ns)
            )
            state = odometry.state_at(event.stamp_ns)
        poses.append([state.x, state.y, state.yaw])
        stamps.append(event.stamp_ns)
    cpu = time.process_time() - begin
    inside, T = interpolate(drive.truth, np.array(stamps, dtype=np.int64))
    truth, estimate = geometry.xyyaw_of(T), np.array(poses)[inside]
    error = np.hypot(*(estimate - truth)[:, :2].T)
    heading = np.rad2deg(np.abs(geometry.wrap_angle(estimate[:, 2] - truth[:, 2])))
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    at = np.searchsorted(way, np.arange(0.0, way[-1], CHORD))
    length, true_length = (float(np.hypot(*np.diff(p[at, :2], axis=0).T).sum()) for p in (estimate, truth))
    return (
        float(error.mean()), float(error[-1]), float(heading.mean()), 100.0 * (length / true_length - 1.0),
        1e3 * cpu / len(poses),
    )  # fmt: skip


def report(name: str, drive: Drive, seeds: int) -> None:
    redrawn = [with_odometry(drive, seed) for seed in range(1, seeds + 1)]
    for method in METHODS:
        variants = redrawn if method.startswith(("integrated", "odometry")) else [drive.events]
        mean, final, heading, length, cpu = np.mean([run(method, drive, events) for events in variants], axis=0)
        figures = f"{mean:.3f} | {final:.3f} | {heading:.2f} | {length:+.1f} | {cpu:.3f}"
        print(f"| {name} | {method} | {figures} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="*", default=WORLDS)
    parser.add_argument("--recordings", type=int, nargs="*", default=(1, 2, 3, 4, 5))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--max-time", type=float, default=300.0)
    chosen = parser.parse_args()
    print("| drive | method | mean (m) | final (m) | heading (deg) | length (%) | CPU (ms) |")
    print("|---|---|---|---|---|---|---|")
    for scenario in chosen.recordings:
        report(f"scenario {scenario}", load(RECORDINGS / f"scenario-{scenario}.mcap"), chosen.seeds)
    for world in chosen.worlds:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "drive.mcap"
            robot = RobotSettings(seed=7, max_time=chosen.max_time)
            settings = SimulationSettings(
                out=Path(folder), world=world, engine="quasi-static", robot=robot, whisker_truth=False
            )
            record_drive(settings, path)
            report(world, load(path), chosen.seeds)


if __name__ == "__main__":
    main()
