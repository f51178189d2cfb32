"""Error metrics agree with evo's to 1e-9: absolute, in the plane, rotation, relative; at different rates."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core import trajectory as evo_trajectory
from scipy.spatial.transform import Rotation

from robominer_slam import geometry
from robominer_slam.evaluation.metrics import ErrorStatistics, TrajectoryErrors, relative_errors, trajectory_errors
from robominer_slam.evaluation.trajectory import Trajectory, interpolate

START = 1_700_000_000_000_000_000
PERIOD_NS = 10_000_000
RELATION = evo_metrics.PoseRelation
SEEDS = range(8)


def wander(seed: int, n: int) -> np.ndarray:
    """Poses of a random walk in space, headings all around."""
    rng = np.random.default_rng(seed)
    xyz = np.cumsum(rng.normal(0, 0.05, (n, 3)), axis=0)
    angles = np.cumsum(rng.normal(0, 0.05, (n, 3)), axis=0) + rng.uniform(-3, 3, 3)
    return geometry.pose_matrix(xyz, Rotation.from_euler("ZYX", angles).as_quat())


def pair(seed: int) -> tuple[Trajectory, Trajectory]:
    """(estimate, truth): the truth at 100 Hz, the estimate at a rate of its own, with error, gaps and an overhang."""
    rng = np.random.default_rng([seed, 1])
    n = int(rng.integers(80, 300))
    truth = Trajectory(START + PERIOD_NS * np.arange(n, dtype=np.int64), wander(seed, n))
    step = int(rng.integers(1, 6))
    places = np.arange(int(rng.integers(0, 5)), n, step)
    places = places[rng.uniform(size=len(places)) < 0.9]
    wrong = geometry.se3_exp(np.cumsum(rng.normal(0, 0.01, (len(places), 6)), axis=0))
    late = Trajectory(truth.stamps_ns[places], truth.T[places] @ wrong)
    beyond = truth.stamps_ns[-1] + PERIOD_NS * np.arange(5, 8)
    return Trajectory(np.append(late.stamps_ns, beyond), np.concatenate([late.T, wander(seed + 50, 3)])), truth


def as_evo(trajectory: Trajectory) -> evo_trajectory.PoseTrajectory3D:
    seconds = (trajectory.stamps_ns - START).astype(float) * 1e-9
    return evo_trajectory.PoseTrajectory3D(poses_se3=list(trajectory.T), timestamps=seconds)


def ape(estimate: Trajectory, truth: Trajectory, relation: RELATION, planar: bool = False) -> evo_metrics.APE:
    pairs = sync.associate_trajectories(as_evo(truth), as_evo(estimate), max_diff=1e-4)
    if planar:
        for one in pairs:
            one.project(evo_trajectory.Plane.XY)
    metric = evo_metrics.APE(relation)
    metric.process_data(pairs)
    return metric


def agree(errors: np.ndarray, metric: evo_metrics.PE) -> None:
    np.testing.assert_allclose(errors, metric.error, rtol=0, atol=1e-9)
    ours, theirs = ErrorStatistics.of(errors), metric.get_all_statistics()
    for name in ("mean", "median", "max", "rmse"):
        assert getattr(ours, name) == pytest.approx(theirs[name], abs=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_distance_in_space(seed):
    estimate, truth = pair(seed)
    agree(trajectory_errors(estimate, truth).distance, ape(estimate, truth, RELATION.translation_part))


@pytest.mark.parametrize("seed", SEEDS)
def test_distance_in_the_plane(seed):
    estimate, truth = pair(seed)
    agree(trajectory_errors(estimate, truth).position, ape(estimate, truth, RELATION.translation_part, planar=True))


@pytest.mark.parametrize("seed", SEEDS)
def test_rotation_angle(seed):
    estimate, truth = pair(seed)
    agree(trajectory_errors(estimate, truth).rotation, ape(estimate, truth, RELATION.rotation_angle_rad))


def test_rotation_angle_of_level_robots_is_the_heading_error():
    rng = np.random.default_rng(3)
    stamps = START + PERIOD_NS * np.arange(50, dtype=np.int64)
    poses = [geometry.T_from_xyyaw(np.column_stack([rng.normal(size=(50, 2)), rng.uniform(-1, 1, 50)])) for _ in "ab"]
    estimate, truth = (Trajectory(stamps, T) for T in poses)
    errors = trajectory_errors(estimate, truth)
    agree(errors.heading, ape(estimate, truth, RELATION.rotation_angle_rad))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("frames", [1, 7, 25])
def test_relative_errors(seed, frames):
    estimate, truth = pair(seed)
    inside, T_truth = interpolate(truth, estimate.stamps_ns)
    pairs = (as_evo(Trajectory(estimate.stamps_ns[inside], T)) for T in (T_truth, estimate.T[inside]))
    pairs = tuple(pairs)
    distance, angle = relative_errors(estimate, truth, frames)
    for errors, relation in ((distance, RELATION.translation_part), (angle, RELATION.rotation_angle_rad)):
        if not len(errors):
            continue
        metric = evo_metrics.RPE(relation, frames, evo_metrics.Unit.frames, all_pairs=True)
        metric.process_data(pairs)
        agree(errors, metric)


def test_between_the_truths_poses_the_geodesic_is_the_truth():
    """evo takes the nearest pose; given the interpolated truth at the estimate's times, it finds the same."""
    estimate, truth = pair(2)
    shifted = Trajectory(estimate.stamps_ns + 3_700_000, estimate.T)
    inside, T_truth = interpolate(truth, shifted.stamps_ns)
    same = Trajectory(shifted.stamps_ns[inside], T_truth)
    agree(trajectory_errors(shifted, truth).distance, ape(shifted, same, RELATION.translation_part))


def test_errors_of_a_perfect_estimate_are_zero():
    _, truth = pair(4)
    errors: TrajectoryErrors = trajectory_errors(truth, truth)
    assert max(errors.distance.max(), errors.position.max(), errors.rotation.max()) < 1e-9
