"""What the thesis leaves unsaid, searched once on scenario 3: a coordinate search over six parameters.

For one recording of the thesis world's scenario 3 and several odometry seeds, each value of each parameter is tried
with the others held; the figure is the mean position error over all frames and seeds. The winner is
frozen as the default of `[slam.thesis]` and the table goes into docs/slam.md.

    robominer-slam simulate --world thesis --scenario 3 --engine physics --record scenario3.mcap
    python benchmarks/thesis_parameter_search.py scenario3.mcap
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import AngleEstimator
from drivers.measurement import HallFrame, OdometrySample
from drivers.recording_reader import Recording
from robominer_slam.configuration.model import ThesisSection
from robominer_slam.contacts import ContactModel
from robominer_slam.estimation.integrated_odometry import IntegratedOdometry
from robominer_slam.estimation.odometry_state import planar_pose
from robominer_slam.evaluation.trajectory import Trajectory, interpolate
from robominer_slam.geometry import from_vector7
from robominer_slam.replay import prepare
from robominer_slam.slam.backend_runner import SynchronousRunner
from robominer_slam.slam.composite_scan import CompositeScan
from robominer_slam.slam.thesis import ThesisBackend
from sim_backend.base_motion import BaseStates
from sim_backend.odometry import BiasedOdometry

FloatArray = NDArray[np.float64]

GRID: dict[str, tuple[float | str, ...]] = {
    "odometry_sigma": (0.0, 0.003, 0.01, 0.02, 0.03),
    "min_travel": (0.5, 1.0, 2.0, 4.0),
    "correspondence_distance": (0.05, 0.1, 0.2, 0.5),
    "closure_spacing": (0.0, 0.15, 0.3, 1.0),
    "scan_voxel": (0.0, 0.02, 0.05, 0.08),
    "kernel": ("none", "huber", "cauchy"),
}
#: Where the search starts: guesses by hand.
START: dict[str, float | str] = {
    "odometry_sigma": 0.01,
    "min_travel": 4.0,
    "correspondence_distance": 0.1,
    "closure_spacing": 0.3,
    "scan_voxel": 0.02,
    "kernel": "huber",
}
LATENCY_NS = 500_000_000


@dataclass(frozen=True)
class Drive:
    """A recording reduced to what the back-end sees: contacts and truth per frame, odometry per seed."""

    stamps_ns: NDArray[np.int64]
    contacts: list[FloatArray]
    truth: FloatArray
    odometry: dict[int, FloatArray]


def load(path: Path, seeds: list[int]) -> Drive:
    inputs = prepare(path, None)
    angles = AngleEstimator(inputs.model)
    contact = inputs.configuration.contact
    model = ContactModel(
        inputs.layout, np.deg2rad(contact.min_inclination_deg), np.deg2rad(contact.max_inclination_deg)
    )
    stamps, contacts = [], []
    for _, measurement in inputs.recording:
        if isinstance(measurement, HallFrame):
            found = angles.angles(measurement.field_mT, measurement.valid)
            stamps.append(measurement.stamp_ns)
            contacts.append(model.contacts(found, found.valid).points)
    stamps_ns = np.array(stamps, dtype=np.int64)
    truths = [truth for _, truth in Recording(path).ground_truth()]
    truth = Trajectory(
        np.array([t.stamp_ns for t in truths], dtype=np.int64), from_vector7(np.array([t.pose for t in truths]))
    )
    inside, poses = interpolate(truth, stamps_ns)
    kept = [c for c, ok in zip(contacts, inside, strict=True) if ok]
    odometry = {seed: odometry_poses(truth, stamps_ns[inside], seed) for seed in seeds}
    return Drive(stamps_ns[inside], kept, poses, odometry)


def odometry_poses(truth: Trajectory, stamps_ns: NDArray[np.int64], seed: int) -> FloatArray:
    """Poses of the thesis's biased odometry at the frames' stamps."""
    noise = BiasedOdometry(seed)
    period_ns = round(1e9 / noise.settings.rate)
    grid = np.arange(int(truth.stamps_ns[0]), int(truth.stamps_ns[-1]) + 1, period_ns, dtype=np.int64)
    _, T = interpolate(truth, grid)
    still = np.zeros((len(grid), 3))
    velocities = noise.sample(BaseStates(T[:, :3, 3], T[:, :3, :3], still, still, still, still))
    samples = [OdometrySample(int(s), v) for s, v in zip(grid[1:], velocities, strict=True)]
    integrated = IntegratedOdometry()
    integrated.add(OdometrySample(int(grid[0]), np.zeros(3)))
    poses = []
    k = 0
    for stamp in stamps_ns:
        while k < len(samples) and samples[k].stamp_ns <= stamp:
            integrated.add(samples[k])
            k += 1
        poses.append(planar_pose(integrated.state_at(int(stamp))))
    return np.array(poses)


def run(drive: Drive, parameters: ThesisSection, seed: int) -> tuple[float, int]:
    """Mean position error, m, and number of closures."""
    composite = CompositeScan(parameters.keyframe_distance, parameters.keyframe_angle, parameters.scan_voxel)
    runner = SynchronousRunner(ThesisBackend(parameters), LATENCY_NS)
    T_map_odom, errors, closures = np.eye(4), [], 0
    for stamp, T_odom, points, truth in zip(
        drive.stamps_ns, drive.odometry[seed], drive.contacts, drive.truth, strict=True
    ):
        for result in runner.due(int(stamp)):
            T_map_odom = result.T_map_odom
            closures += result.closures
        keyframe = composite.add(int(stamp), T_odom, points)
        if keyframe is not None:
            runner.submit(keyframe)
        errors.append(np.linalg.norm((T_map_odom @ T_odom - truth)[:2, 3]))
    return float(np.mean(errors)), closures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    drive = load(arguments.recording, arguments.seeds)
    odometry = np.mean(
        [np.linalg.norm((poses - drive.truth)[:, :2, 3], axis=1).mean() for poses in drive.odometry.values()]
    )
    print(f"odometry alone: {odometry:.3f} m over {len(arguments.seeds)} seeds, {len(drive.stamps_ns)} frames")
    best = dict(START)
    known: dict[tuple[float | str, ...], tuple[float, float]] = {}
    with ProcessPoolExecutor(arguments.workers) as pool:
        for round_number in range(1, arguments.rounds + 1):
            for name, values in GRID.items():
                for value in values:
                    tried = {**best, name: value}
                    key = tuple(tried[n] for n in GRID)
                    if key not in known:
                        section = ThesisSection(**tried)
                        n = len(arguments.seeds)
                        results = list(pool.map(run, [drive] * n, [section] * n, arguments.seeds))
                        known[key] = (
                            float(np.mean([error for error, _ in results])),
                            float(np.mean([count for _, count in results])),
                        )
                    error, closures = known[key]
                    print(f"| {round_number} | {name} | {value} | {error:.3f} | {closures:.1f} |", flush=True)
                best[name] = min(values, key=lambda v: known[tuple({**best, name: v}[n] for n in GRID)][0])
                print(f"|  | {name} | **{best[name]}** | | |", flush=True)
    print("best:", best, "mean error", known[tuple(best[n] for n in GRID)][0])


if __name__ == "__main__":
    main()
