"""The waypoint path: smooth, within its speeds, through every waypoint."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sim_backend import world
from sim_backend.waypoints import DriveSettings, WaypointPath

STEP = 0.002


def sampled(path):
    time = np.arange(-0.5, path.duration + 0.5, STEP)
    return time, path.at(time)


@pytest.fixture(scope="module")
def scenario_1():
    return WaypointPath(world.thesis().scenario(1))


def test_velocity_is_the_derivative_of_the_pose_and_has_no_step(scenario_1):
    _, motion = sampled(scenario_1)
    slope = np.gradient(motion.pose, STEP, axis=0)
    assert np.abs(slope - motion.velocity)[1:-1].max() < 1e-5
    # The largest acceleration allows this much change between two samples, and no more.
    assert np.abs(np.diff(motion.velocity, axis=0)).max() < 1.01 * STEP * 1.5 * 0.4
    assert np.abs(np.diff(motion.velocity[:, :2], axis=0)).max() < 1.01 * STEP * 1.5 * 0.15


def test_acceleration_is_the_derivative_of_the_velocity_and_has_no_step(scenario_1):
    _, motion = sampled(scenario_1)
    slope = np.gradient(motion.velocity, STEP, axis=0)
    assert np.abs(slope - motion.acceleration)[1:-1].max() < 0.01
    assert np.abs(np.diff(motion.acceleration, axis=0)).max() < 0.01


def test_speeds_are_reached_and_kept(scenario_1):
    _, motion = sampled(scenario_1)
    assert np.hypot(motion.velocity[:, 0], motion.velocity[:, 1]).max() == pytest.approx(0.15)
    assert np.abs(motion.velocity[:, 2]).max() == pytest.approx(0.4)


def test_the_robot_stands_still_first_and_at_every_waypoint(scenario_1):
    time, motion = sampled(scenario_1)
    assert (motion.velocity[time < 2.0] == 0.0).all()
    still = np.abs(motion.velocity).max(axis=1) < 1e-4
    for x, y, heading in world.thesis().scenario(1):
        distance = np.abs(motion.pose - [x, y, heading]).max(axis=1)
        assert distance[still].min() < 1e-4


def test_a_leg_too_short_for_full_speed_is_still_smooth_and_arrives():
    path = WaypointPath([[0, 0, 0], [0.03, 0, 0.1]], DriveSettings(rest_before=0.0))
    _, motion = sampled(path)
    np.testing.assert_allclose(motion.pose[-1], [0.03, 0, 0.1], atol=1e-12)
    assert motion.velocity[:, 0].max() < 0.15
    assert np.abs(np.diff(motion.velocity, axis=0)).max() < 1e-3


def test_scenario_1_fits_into_the_demo(scenario_1):
    assert scenario_1.duration < 140.0


def test_a_single_waypoint_is_a_robot_that_stands():
    motion = WaypointPath([[1.0, 2.0, 0.5]]).at([0.0, 1.0])
    np.testing.assert_allclose(motion.pose, [[1.0, 2.0, 0.5]] * 2)
    assert (motion.velocity == 0.0).all()


@pytest.mark.shared_data
def test_scenarios_are_those_of_the_shared_file(shared_data):
    data = json.loads((shared_data / "scenarios.json").read_text())
    for number, scenario in data["scenarios"].items():
        waypoints = world.thesis().scenario(int(number))
        expected = np.array(scenario["waypoints"]) * [1.0, 1.0, np.pi / 180.0]
        np.testing.assert_allclose(waypoints, expected, atol=1e-12)
        path = WaypointPath(waypoints)
        assert path.length == pytest.approx(scenario["length_m"], abs=0.006)
        # The shared durations are without ramps and rests.
        ramps_and_rests = path.settings.ramp * (len(waypoints) - 1) + 3.0
        assert path.duration - ramps_and_rests == pytest.approx(scenario["duration_s"], abs=0.06)


@pytest.mark.shared_data
def test_objects_are_those_of_the_shared_file(shared_data):
    from importlib.resources import files

    data = json.loads((shared_data / "scenarios.json").read_text())
    own = json.loads(files("sim_backend").joinpath("thesis_world.json").read_text())
    assert own["objects"] == data["objects"]
    assert own["points"] == data["points"]
    assert own["ground"]["extent_m"] == data["ground"]["extent_m"]
