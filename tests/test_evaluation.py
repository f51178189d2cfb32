"""Metrics against evo, closures against their definition, TUM text."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import trajectory as evo_trajectory
from scipy.spatial.transform import Rotation, Slerp

from robominer_slam import geometry
from robominer_slam.evaluation.metrics import ErrorStatistics, trajectory_errors
from robominer_slam.evaluation.pose_graph_errors import closure_errors
from robominer_slam.evaluation.report import drive_report, report_rows
from robominer_slam.evaluation.trajectory import Trajectory, TrajectoryError, interpolate, parse_tum, tum_line

START = 1_700_000_000_000_000_000


def random_trajectory(seed: int, n: int = 60, planar: bool = True) -> Trajectory:
    rng = np.random.default_rng(seed)
    stamps = START + np.cumsum(rng.integers(30, 50, n)) * 1_000_000
    xyz = np.cumsum(rng.normal(0, 0.05, (n, 3)), axis=0)
    angles = np.cumsum(rng.normal(0, 0.05, (n, 3)), axis=0)
    if planar:
        xyz[:, 2] = 0
        angles[:, 1:] = 0
    T = geometry.pose_matrix(xyz, Rotation.from_euler("ZYX", angles).as_quat())
    return Trajectory(stamps.astype(np.int64), T)


def as_evo(trajectory: Trajectory) -> evo_trajectory.PoseTrajectory3D:
    return evo_trajectory.PoseTrajectory3D(
        poses_se3=list(trajectory.T), timestamps=(trajectory.stamps_ns - START).astype(float) * 1e-9
    )


def test_position_errors_equal_evo():
    truth = random_trajectory(1)
    estimate = Trajectory(truth.stamps_ns, random_trajectory(2).T)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((as_evo(truth), as_evo(estimate)))
    statistics = ErrorStatistics.of(trajectory_errors(estimate, truth).position)
    expected = ape.get_all_statistics()
    assert statistics.mean == pytest.approx(expected["mean"], abs=1e-9)
    assert statistics.median == pytest.approx(expected["median"], abs=1e-9)
    assert statistics.max == pytest.approx(expected["max"], abs=1e-9)
    assert statistics.rmse == pytest.approx(expected["rmse"], abs=1e-9)


def test_heading_errors_equal_evo():
    truth = random_trajectory(3)
    estimate = Trajectory(truth.stamps_ns, random_trajectory(4).T)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.rotation_angle_rad)
    ape.process_data((as_evo(truth), as_evo(estimate)))
    np.testing.assert_allclose(trajectory_errors(estimate, truth).heading, ape.error, atol=1e-7)


def test_roll_pitch_yaw_equal_scipy():
    R = Rotation.random(50, random_state=0)
    np.testing.assert_allclose(geometry.rpy_of(R.as_matrix()), R.as_euler("ZYX")[:, ::-1], atol=1e-9)


def test_interpolation_is_linear_in_place_and_spherical_in_heading():
    truth = random_trajectory(5, n=2)
    middle = np.array([truth.stamps_ns[0] + (truth.stamps_ns[1] - truth.stamps_ns[0]) // 4])
    inside, T = interpolate(truth, middle)
    assert inside.tolist() == [True]
    slerp = Slerp([0, 1], Rotation.from_matrix(truth.T[:, :3, :3]))(0.25)
    np.testing.assert_allclose(T[0, :3, :3], slerp.as_matrix(), atol=1e-7)
    straight = 0.75 * truth.T[0, :3, 3] + 0.25 * truth.T[1, :3, 3]
    assert np.linalg.norm(T[0, :3, 3] - straight) < 2e-3
    outside, _ = interpolate(truth, np.array([START - 1]))
    assert not outside.any()


def graph_of(truth: Trajectory, errors: list[tuple[float, float]]) -> dict:
    ids = range(0, 60, 10)
    edges = []
    for k, (distance, angle) in enumerate(errors):
        i, j = 10 * k, 50
        wrong = geometry.pose_matrix([distance, 0, 0], Rotation.from_rotvec([0, 0, angle]).as_quat())
        T = geometry.inverse(truth.T[i]) @ truth.T[j] @ wrong
        edges.append(
            {"kind": "loop", "i": i, "j": j, "T_i_j": geometry.to_vector7(T).tolist(), "information": [], "weight": 1.0}
        )
    edges.append({"kind": "odometry", "i": 0, "j": 10, "T_i_j": [9, 9, 9, 0, 0, 0, 1], "information": [], "weight": 1})
    keyframes = [
        {"id": i, "stamp_ns": int(truth.stamps_ns[i]), "pose": geometry.to_vector7(truth.T[i]).tolist()} for i in ids
    ]
    return {"version": 3, "keyframes": keyframes, "edges": edges}


def test_a_closure_is_wrong_beyond_ten_centimetres_or_five_degrees():
    truth = random_trajectory(6)
    graph = graph_of(truth, [(0.0, 0.0), (0.099, 0.0), (0.101, 0.0), (0.0, np.deg2rad(4.9)), (0.0, np.deg2rad(5.1))])
    closures = closure_errors(graph, truth)
    assert closures.wrong.tolist() == [False, False, True, False, True]
    np.testing.assert_allclose(closures.distance[2], 0.101, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(closures.angle[4]), 5.1, atol=1e-9)


def test_a_drive_report_names_everything():
    truth = random_trajectory(7)
    report = drive_report(
        truth, truth, truth, graph_of(truth, [(0.3, 0.0), (0.0, 0.0)]), cpu_s=1.0, peak_memory_mb=80.0
    )
    described = report.as_dict()
    assert described["slam"]["position_m"]["max"] < 1e-12
    assert (described["loop_closures"], described["wrong_loop_closures"]) == (2, 1)
    errors, figures = report_rows(report)
    assert [row[1] for row in errors] == ["odometry", "SLAM"] * 2
    assert dict(figures)["peak memory of the daemon"] == "80 MB"


def test_tum_text_keeps_stamps_to_the_nanosecond():
    trajectory = random_trajectory(8)
    text = [tum_line(int(s), T) for s, T in zip(trajectory.stamps_ns + 123, trajectory.T, strict=True)]
    back = parse_tum(["# a comment\n", *text], "t.tum")
    np.testing.assert_array_equal(back.stamps_ns, trajectory.stamps_ns + 123)
    np.testing.assert_allclose(back.T, trajectory.T, atol=1e-8)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (["1 2 3\n"], "line 1: expected timestamp"),
        (["1.0 0 0 0 0 0 0 nan\n"], "line 1"),
        (["2 0 0 0 0 0 0 1\n", "1 0 0 0 0 0 0 1\n"], "line 2: expected ascending"),
        ([], "no poses"),
    ],
)
def test_a_bad_trajectory_is_refused(lines, expected):
    with pytest.raises(TrajectoryError, match=expected):
        parse_tum(lines, "t.tum")
