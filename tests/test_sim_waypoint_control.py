"""Waypoints that are added while the robot drives: the growing path, the control channel, and both as processes."""

from __future__ import annotations

import json
import math
import re
import signal
import socket
import subprocess
import threading
from contextlib import contextmanager

import numpy as np
import pytest

from sim_backend import world
from sim_backend.control_socket import LONGEST_LINE, ControlSocket, NoSimulationError, ask
from sim_backend.demo import program
from sim_backend.events import TruthEvent, WhiskerEvent
from sim_backend.extendable_path import ExtendablePath, PathClosedError
from sim_backend.robot import RobotSettings, build_robot
from sim_backend.waypoint_control import WaypointControl
from sim_backend.waypoints import WaypointPath


def test_what_has_been_told_stays_when_a_waypoint_is_added():
    path = ExtendablePath([[0.0, 0.0, 0.0]], waits=True)
    time = np.arange(0.0, 7.0, 0.02)
    before = path.at(time).pose
    leg = path.extend(0.5, 0.0, np.pi / 2)
    assert leg.start == pytest.approx(time[-1])
    np.testing.assert_array_equal(path.at(time).pose, before)
    np.testing.assert_allclose(path.at([leg.end]).pose, [[0.5, 0.0, np.pi / 2]], atol=1e-12)


def test_a_leg_follows_the_one_before_without_a_rest_where_nobody_has_looked():
    grown = ExtendablePath([[0.0, 0.0, 0.0]], waits=True)
    grown.extend(0.5, 0.0, 0.0)
    grown.extend(0.5, 0.3, 1.0)
    planned = WaypointPath([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.5, 0.3, 1.0]])
    time = np.linspace(0.0, planned.duration, 500)
    for one, other in zip(vars_of(grown.at(time)), vars_of(planned.at(time)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert grown.duration == math.inf
    assert grown.finish() == pytest.approx(planned.duration)


def vars_of(motion):
    return motion.pose, motion.velocity, motion.acceleration


def test_a_grown_path_has_no_steps_in_velocity():
    path = ExtendablePath([[0.0, 0.0, 0.0]], waits=True)
    for k in range(1, 40):
        path.at([0.5 * k])
        if k % 9 == 0:
            path.extend(0.02 * k, 0.01 * k, 0.1 * k)
    time = np.arange(0.0, 40.0, 0.002)
    motion = path.at(time)
    slope = np.gradient(motion.pose, 0.002, axis=0)
    assert np.abs(slope - motion.velocity)[1:-1].max() < 1e-5


@pytest.mark.parametrize(("heading", "turn"), [(350.0, -10.0), (170.0, 170.0), (-170.0, -170.0), (725.0, 5.0)])
def test_the_shorter_way_round_is_turned(heading, turn):
    path = ExtendablePath([[0.0, 0.0, 4.0 * np.pi]])
    leg = path.extend(1.0, 0.0, np.deg2rad(heading))
    assert np.rad2deg(leg.waypoint[2]) == pytest.approx(720.0 + turn)


def test_no_waypoint_follows_a_drive_that_is_over():
    path = ExtendablePath([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    assert not path.close(path.duration - 0.01)
    path.extend(0.2, 0.0, 0.0)
    assert not path.close(100.0)  # it waits for more
    path.finish()
    assert path.close(100.0)
    with pytest.raises(PathClosedError):
        path.extend(0.3, 0.0, 0.0)


def test_a_robot_that_waits_stands_still_and_then_drives_on_where_it_was_told():
    robot = build_robot("flat", 0, "quasi-static")
    truth, whiskers = [], 0
    for event in robot.events():
        whiskers += isinstance(event, WhiskerEvent)
        if not isinstance(event, TruthEvent):
            continue
        truth.append(event)
        if len(truth) == 200:
            robot.path.extend(0.3, 0.2, 0.5)
        if len(truth) == 500:
            robot.path.finish()
    position = np.array([event.position for event in truth])
    assert len(truth) >= 500
    assert whiskers == len(truth)
    np.testing.assert_array_equal(position[:200], 0.0)
    np.testing.assert_allclose(position[-1], [0.3, 0.2, 0.0], atol=1e-9)
    np.testing.assert_array_equal(np.diff([event.time_ns for event in truth]), 40_000_000)
    with pytest.raises(PathClosedError):
        robot.path.extend(0.3, 0.2, 0.5)


def test_a_scenario_goes_on_with_the_waypoint_that_was_added():
    robot = build_robot("flat", 1, "quasi-static", RobotSettings(max_time=300.0))
    planned = robot.duration
    robot.path.extend(0.0, 0.4, np.pi)  # as the scenario ends
    robot.path.finish()
    assert robot.duration == pytest.approx(planned + 0.4 / 0.15 + 1.0)
    assert robot.motion.length == pytest.approx(WaypointPath(world.load("flat").scenario(1)).length + 0.4)


def test_a_limit_cuts_the_waiting_short():
    robot = build_robot("flat", 0, "quasi-static", RobotSettings(max_time=3.1))
    assert robot.duration == 3.1
    assert sum(isinstance(event, TruthEvent) for event in robot.events()) == 77
    with pytest.raises(PathClosedError):
        robot.path.extend(0.3, 0.2, 0.5)


@pytest.mark.parametrize(
    ("request_line", "expected"),
    [
        (b'{"add_waypoint": [NaN, 0, 0]}', "finite numbers"),
        (b'{"add_waypoint": [0, Infinity, 0]}', "finite numbers"),
        (b'{"add_waypoint": [0, 1e999, 0]}', "finite numbers"),
        (b'{"add_waypoint": [0, 0]}', "three numbers"),
        (b'{"add_waypoint": [0, 0, true]}', "three numbers"),
        (b'{"add_waypoint": {"x": 0}}', "three numbers"),
        (b'{"add_waypoint": [9, 0, 0]}', "outside the ground"),
        (b'{"add_waypoint": [4.3, 0, 0]}', "expected x from -0.91 to 4.11"),
        (b'{"go": 1}', "expected"),
        (b"\xff\x00", "expected"),
        (b"[" * 4000, "expected"),
        (b"", "expected"),
    ],
)
def test_wrong_requests_are_answered_and_change_nothing(request_line, expected):
    path = ExtendablePath([[0.0, 0.0, 0.0]])
    reply = WaypointControl(world.load("flat"), path).answer(request_line)
    assert reply.endswith(b"\n")
    assert expected in json.loads(reply)["error"]
    assert len(path.waypoints) == 1


def test_ways_through_rock_are_refused():
    scene = world.load("mine")
    path = ExtendablePath(scene.scenario(0), waits=True)
    control = WaypointControl(scene, path)
    junction = scene.scenario(2)[2]
    for x, y in ([4.0, 4.0], [4.0, -4.0], [-500.0, 0.0]):
        reply = json.loads(control.answer(json.dumps({"add_waypoint": [x, y, 0.0]}).encode()))
        assert "through rock" in reply["error"]
    assert "starts_s" in json.loads(control.answer(json.dumps({"add_waypoint": [*junction[:2], 0.0]}).encode()))


@contextmanager
def listening(folder, answer):
    control, done = ControlSocket(folder, answer), threading.Event()

    def loop():
        import select

        while not done.is_set():
            control.serve(select.select(control.sockets(), [], [], 0.01)[0])

    thread = threading.Thread(target=loop, name="control")
    thread.start()
    try:
        yield control
    finally:
        done.set()
        thread.join()
        control.close()


def test_the_channel_answers_line_by_line_in_folders_with_long_names(tmp_path):
    folder = tmp_path / ("long" * 40)
    folder.mkdir()
    with listening(folder, lambda line: line.upper() + b"\n"):
        assert ask(folder, b"one") == b"ONE"
        assert ask(folder, b"two") == b"TWO"
    assert not (folder / "control").exists()
    with pytest.raises(NoSimulationError, match="no simulation runs there"):
        ask(folder, b"three")


def test_the_channel_survives_clients_that_misbehave(tmp_path):
    with listening(tmp_path, lambda line: line + b"\n"):
        for _ in range(3):
            with socket.socket(socket.AF_UNIX) as endless:
                endless.connect(str(tmp_path / "control"))
                endless.sendall(b"x" * (LONGEST_LINE + 1))
                assert endless.recv(1) == b""  # cut off
            with socket.socket(socket.AF_UNIX) as gone:
                gone.connect(str(tmp_path / "control"))
                gone.sendall(b"half a li")
        assert ask(tmp_path, b"still there") == b"still there"


def test_a_socket_left_by_a_killed_simulation_is_replaced(tmp_path):
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(tmp_path / "control"))
    left.close()
    with pytest.raises(NoSimulationError):
        ask(tmp_path, b"")
    with listening(tmp_path, lambda line: line + b"\n"):
        assert ask(tmp_path, b"here") == b"here"


def waypoint(folder, *arguments):
    return subprocess.run(
        program("waypoint", *arguments, "--out", str(folder)), capture_output=True, text=True, timeout=60, check=False
    )


@contextmanager
def simulation(folder, *arguments):
    process = subprocess.Popen(
        program("simulate", "--world", "flat", "--scenario", "0", "--engine", "quasi-static", "--rate", "10",
                "--wait", "0", "--out", str(folder), "--json", *arguments),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_waypoints_are_added_to_a_running_simulation(tmp_path):
    with simulation(tmp_path) as process:
        ready = json.loads(process.stdout.readline())
        assert ready["duration"] is None
        refused = [waypoint(tmp_path, *place) for place in (["nan", "0", "0"], ["50", "0", "0"])]
        first = waypoint(tmp_path, "0.5", "0", "0")
        second = waypoint(tmp_path, "0.4", "-0.3", "-90", "--end")
        assert process.wait(timeout=60) == 0, process.stderr.read()
        assert json.loads(process.stdout.readline())["event"] == "done"
    for done, reason in zip(refused, ("finite numbers", "outside the ground"), strict=True):
        assert done.returncode == 2
        assert reason in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert first.returncode == second.returncode == 0, first.stderr + second.stderr
    times = [float(t) for t in re.findall(r"([0-9.]+) s", first.stdout + second.stdout)]
    assert times == sorted(times)
    truth = np.loadtxt(tmp_path / "ground_truth.txt")
    t, p = truth[:, 0] - truth[0, 0], truth[:, 1:3]
    for place in ([0.5, 0.0], [0.4, -0.3]):
        assert np.linalg.norm(p - place, axis=1).min() < 0.005
    np.testing.assert_allclose(p[-1], [0.4, -0.3], atol=1e-3)
    heading = 2.0 * np.arctan2(truth[-1, 6], truth[-1, 7])
    assert np.rad2deg(heading) == pytest.approx(-90.0, abs=0.5)
    # Truth is stamped in host time: ten simulated seconds pass in one.
    assert 10.0 * t[-1] == pytest.approx(times[-1], abs=0.1)
    assert not (tmp_path / "control").exists()


def test_a_simulation_that_waits_ends_on_sigterm(tmp_path):
    with simulation(tmp_path) as process:
        process.stdout.readline()
        assert waypoint(tmp_path, "0.5", "0", "0").returncode == 0
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=30) == 0
        assert json.loads(process.stdout.readline())["stopped"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["1", "0", "90"], "no simulation runs there"),
        (["--end"], "no simulation runs there"),
        (["1", "0"], "expected X Y HEADING_DEG or --end, found 2 numbers"),
        ([], "found 0 numbers"),
    ],
)
def test_a_mistake_is_one_clear_line_and_exit_code_2(arguments, expected, tmp_path):
    done = waypoint(tmp_path / "nothing", *arguments)
    assert done.returncode == 2
    assert expected in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_drive_without_end_is_not_recorded(tmp_path):
    done = subprocess.run(
        program("simulate", "--scenario", "0", "--engine", "quasi-static", "--out", str(tmp_path),
                "--record", str(tmp_path / "drive.mcap")),
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "--max-time" in done.stderr
