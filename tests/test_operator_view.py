"""What the console keeps of a robot: frames from either link, history in fixed memory, map by chunks, outages."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from robominer_slam import geometry
from robominer_slam.operator.array_model import layout_of_mounts
from robominer_slam.operator.live_frame import LiveFrame
from robominer_slam.operator.map_model import CHUNK, MapModel
from robominer_slam.operator.readings import ProcessorMeter, place_fields, readings
from robominer_slam.operator.robot_view import RobotView
from robominer_slam.operator.session_history import SessionHistory
from robominer_slam.operator.status_entries import StatusEntry, faults_in_words, whisker_faults
from robominer_slam.operator.status_history import PastStatus, StatusHistory
from robominer_slam.operator.traffic import Traffic
from robominer_slam.publishing import map_state, pose_messages
from robominer_slam.publishing.map_state import MapState
from robominer_slam.publishing.pose_messages import StampedTransform
from robominer_slam.publishing.report_messages import Level
from robominer_slam.publishing.telemetry import Health, Telemetry

POSE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
SECOND = 1_000_000_000


def frame(seconds: float, x: float = 0.0, whiskers: int = 4) -> LiveFrame:
    pose = POSE.copy()
    pose[0] = x
    angles = np.full(whiskers, 0.5)
    return LiveFrame(int(seconds * SECOND), pose, np.array([1e-4, 0.0, 1e-4, 1e-4]), "tracking", angles, angles)


def telemetry(seconds: float, **changes) -> Telemetry:
    inclination = np.zeros((8, 8))
    inclination[0, 0], inclination[1, 1] = 0.4, np.nan
    made = Telemetry(
        0, int(seconds * SECOND), "tracking", POSE, np.full(6, 0.05), np.zeros(3), 1, inclination, np.zeros((8, 8))
    )
    return replace(made, **changes)


def test_telemetry_alone_makes_frames_and_exact_angles_are_preferred():
    view = RobotView()
    view.take_telemetry(telemetry(1.0))
    assert view.layout is not None
    assert view.layout.name == "thesis-grid"
    assert view.live.state == "tracking"
    assert view.live.inclination[0] == 0.4
    exact = np.zeros(64)
    exact[0] = 0.41
    view.take_pose(int(1.1 * SECOND), POSE, np.array([1.0, 0.2, 1.0, 0.1]))
    view.take_angles(int(1.1 * SECOND), exact, np.zeros(64))
    view.take_telemetry(telemetry(1.05, state="dead_reckoning"))
    # The older pose and the coarse angles do not replace what is better; the state does.
    assert view.live.stamp_ns == int(1.1 * SECOND)
    assert view.live.inclination[0] == 0.41
    assert np.isnan(view.live.inclination[9])
    assert view.live.covariance[1] == 0.2
    assert view.live.state == "dead_reckoning"


def test_the_way_is_summed_without_noise_and_without_jumps():
    view = RobotView()
    for k in range(101):
        view.take_frame(frame(k, 0.03 * k + (0.002 if k % 2 else 0.0)))
    for k in range(100):
        view.take_frame(frame(200 + k, 3.0 + (0.005 if k % 2 else 0.0)))
    view.take_frame(frame(400, 50.0))
    assert abs(view.driven_m - 3.0) < 0.25


def test_history_is_bounded_and_finds_any_moment():
    history = SessionHistory(capacity=100)
    for k in range(1000):
        history.add(frame(k, float(k)))
    assert len(history) <= 100
    assert history.span_ns == (0, 999 * SECOND)
    assert history.at(998 * SECOND + 5).pose[0] == 998.0
    assert history.at(-5).pose[0] == 0.0
    old = history.at(500 * SECOND)
    assert abs(old.pose[0] - 500.0) < 30.0
    assert history.trail(20).shape == (20, 4)
    assert history.trail(20, 990 * SECOND)[:, 1].tolist() == [float(x) for x in range(990, 1000)]
    last = history.whisker(2, 999 * SECOND, 10.0)
    assert (last[:, 0] >= -10.0).all()
    assert np.allclose(last[:, 1], 0.5, atol=1e-3)
    assert history.whisker(99, 999 * SECOND, 10.0).shape == (0, 3)


def test_frames_closer_than_the_interval_are_not_kept():
    history = SessionHistory()
    for k in range(100):
        history.add(frame(0.04 * k))
    assert 33 <= len(history) <= 41


def state_of(poses: dict[int, tuple[float, float]], version: int, map_id: int = 7) -> MapState:
    points = map_state.quantise_points([[0.1, 0.0, -0.1], [0.0, 0.1, -0.2]])[0]
    quantised = {k: tuple(map_state.quantise_poses([[x, y, 0, 0, 0, 0, 1]])[0].tolist()) for k, (x, y) in poses.items()}
    keyframes = {k: map_state.keyframe(k * SECOND, pose, points) for k, pose in quantised.items()}
    return MapState(map_id, version, keyframes)


def test_a_corrected_graph_moves_points_without_sending_them_again():
    model = MapModel()
    model.update(state_of({1: (0, 0), 2: (1, 0)}, 1))
    points = model.chunk_revision[0]
    assert model.points == 4
    assert np.allclose(sorted(model.cloud()[:, 0]), [0.0, 0.1, 1.0, 1.1], atol=1e-4)
    model.update(state_of({1: (0, 0), 2: (2, 0)}, 2))
    assert model.chunk_revision[0] == points
    assert model.pose_revision[1] == model.revision > model.pose_revision[0]
    assert np.allclose(model.poses[1, :4], [2.0, 0.0, 0.0, 1.0])
    assert model.spacing() == pytest.approx(0.03)
    low, high = model.height_range()
    assert -0.21 < low < high < -0.09


def test_keyframes_go_and_another_map_begins():
    model = MapModel()
    model.update(state_of({k: (k, 0) for k in range(CHUNK + 5)}, 1))
    assert len(model.chunk_revision) == 2
    assert model.chunk(1).shape == (10, 4)
    assert model.bounds()[0, 3] > 0.5 * (CHUNK - 1)
    model.update(state_of({k: (k, 0) for k in range(2, CHUNK + 5)}, 2))
    assert model.poses[0, 3] == model.poses[1, 3] == 0.0
    assert model.points == 2 * (CHUNK + 3)
    assert model.slots_until(10 * SECOND) == 11
    model.set_closures([(2, 9), (0, 5)])
    assert model.closures.tolist() == [[2, 9]]
    generation = model.generation
    model.update(state_of({0: (0, 0)}, 1, map_id=8))
    assert (model.generation, model.count, model.points) == (generation + 1, 1, 2)


def test_outages_and_rates_are_told():
    traffic = Traffic()
    for k in range(100):
        traffic.count("pose", 500, 0.1 * k, live=True)
    assert traffic.rate_hz("pose", 9.9) == pytest.approx(10.0, abs=0.3)
    assert traffic.kilobits_per_s(9.9) == pytest.approx(40.0, rel=0.03)
    traffic.count("pose", 500, 30.0, live=True)
    assert traffic.outage_count == 1
    assert traffic.outage_total_s == pytest.approx(20.1)
    assert traffic.live_age_s(30.5) == pytest.approx(0.5)


def test_faults_are_said_once_and_in_words():
    values = {"whisker (1, 2)": "stuck for 3 s", "invalid": "(0, 3)"}
    entries = [
        StatusEntry("whiskers", Level.WARN, "1 left out: (1, 2) stuck", values),
        StatusEntry("store", Level.OK, "fine", {}),
    ]
    words = faults_in_words(entries, Health.WHISKERS_FAULTY | Health.STORE_FAILING)
    assert words == ["whiskers: 1 left out: (1, 2) stuck", "The map is not being stored on the robot's disk"]
    assert whisker_faults(entries, 8) == {10: "stuck for 3 s", 3: "no usable reading"}


def test_the_mounts_of_a_robot_make_its_array():
    turn = geometry.to_vector7(geometry.pose_matrix([0.1, 0.2, 0.3], [1.0, 0.0, 0.0, 0.0]))
    message = pose_messages.transforms(
        [StampedTransform(0, "base_link", "whisker_1_2", turn), StampedTransform(0, "base_link", "imu", turn)]
    )
    layout = layout_of_mounts(message, 2, 4)
    assert (layout.rows, layout.cols, int(layout.present.sum())) == (2, 4, 1)
    assert np.allclose(layout.p_base[6], [0.1, 0.2, 0.3])
    assert layout_of_mounts(pose_messages.transforms([StampedTransform(0, "base_link", "imu", turn)]), 0, 0) is None


def test_a_place_that_is_not_known_is_not_given_in_centimetres():
    lost = replace(frame(0), covariance=np.array([100.0, 0.0, 100.0, 10.0]), state="lost")
    assert place_fields(lost)["sigma"] == "unknown"
    assert place_fields(frame(0, x=-1e-4))["x"] == "0.00 m"
    assert place_fields(None)["state"] == "not heard yet"


def test_readings_of_a_view_that_has_heard_nothing():
    found = readings(RobotView(), ProcessorMeter())
    assert found["age"] is None
    assert found["faults"] == []
    meter = ProcessorMeter()
    assert math.isnan(meter.share(1.0, 0.0))
    assert meter.share(1.5, 1.0) == pytest.approx(50.0)


def test_what_the_robot_said_is_found_again_in_bounded_memory():
    history = StatusHistory(capacity=100)
    for k in range(1000):
        entry = StatusEntry("store", Level.WARN if k == 990 else Level.OK, f"said at {k}", {"disk.free_MB": str(k)})
        history.add(PastStatus(k * 10**9, (entry,), Health.PAUSED if k == 990 else Health.FINE))
    assert len(history) <= 100
    assert history.at(-1) is None
    first, late = history.at(0), history.at(990 * 10**9 + 5)
    assert (first.entries[0].message, late.entries[0].message) == ("said at 0", "said at 990")
    assert (late.entries[0].level, late.health) == (Level.WARN, Health.PAUSED)
    assert history.before(990 * 10**9 + 5).entries[0].values == {"disk.free_MB": "989"}
