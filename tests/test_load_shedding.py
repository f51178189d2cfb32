"""A computer that cannot keep up: work is left out in order and taken up again; poses go on."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import time
from pathlib import Path

import pytest

from drivers.ros_messages import deserialize
from robominer_slam.assembly import build_pipeline
from robominer_slam.configuration.load_section import LoadSection
from robominer_slam.load_shedding import LoadShedding, Shed
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings
from robominer_slam.replay import prepare
from sim_backend.demo import free_port, program

LIMIT_S = 60.0


def test_one_more_step_a_second_while_late_and_back_one_by_one() -> None:
    shedding = LoadShedding(LoadSection(max_lag=0.3, max_behind=2.0, recovery=10.0))
    levels = []
    for second in range(8):
        shedding.frame(0.02, 0.0)
        shedding.frame(0.5 if second < 6 else 0.1, 0.0)
        levels.append(shedding.turn(float(second)))
    assert levels == [1, 2, 3, 3, 3, 3, 3, 3]
    assert (shedding.lag_s, shedding.times) == (0.1, 3)
    for second in range(8, 50):
        shedding.frame(0.1, 0.0)
        levels.append(shedding.turn(float(second)))
    changes = [k for k in range(1, len(levels)) if levels[k] < levels[k - 1]]
    assert changes == [16, 26, 36]
    assert levels[-1] is Shed.NOTHING


def test_a_late_back_end_counts_and_hardly_in_time_is_not_well() -> None:
    shedding = LoadShedding(LoadSection(max_lag=0.3, max_behind=2.0, recovery=5.0))
    shedding.frame(0.02, 2.5)
    assert shedding.turn(0.0) is Shed.MAP_DETAIL
    for second in range(1, 60):
        shedding.frame(0.2, 0.0)
        assert shedding.turn(float(second)) is Shed.MAP_DETAIL


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


def test_a_daemon_that_is_held_up_says_so_and_recovers(tmp_path: Path, endpoint: str) -> None:
    """Suspended for two thirds of the time, as on a board that others keep busy; afterwards left alone."""
    robot = subprocess.Popen(
        program("simulate", "--scenario", "0", "--engine", "quasi-static", "--out", str(tmp_path), "--json",
                "--listen", endpoint),
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    daemon = None
    try:
        assert robot.stdout is not None
        assert json.loads(robot.stdout.readline())
        with (tmp_path / "config.toml").open("a") as config:
            config.write("\n[load]\nmax_lag = 0.6\nrecovery = 1.0\n")
        with (tmp_path / "log").open("wb") as log:
            daemon = subprocess.Popen(
                program("run", "--config", str(tmp_path / "config.toml")),
                stderr=log, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
        loads: queue.Queue[tuple[int, str]] = queue.Queue()
        poses: list[float] = []

        def on_status(received) -> None:
            for entry in deserialize(received.payload, "diagnostic_msgs/msg/DiagnosticArray").status:
                if entry.name == "load":
                    loads.put((int({v.key: v.value for v in entry.values}["level"]), entry.message))

        settings = ZenohSettings(connect=(endpoint,), mode="client", connect_timeout_s=LIMIT_S)
        with ZenohBus(settings, "robominer/rm3") as bus:
            bus.subscriber("status", on_status)
            bus.subscriber("pose", lambda _: poses.append(time.monotonic()))

            def until(level: int, *, held_up: bool) -> str:
                end = time.monotonic() + LIMIT_S
                while time.monotonic() < end:
                    if held_up:
                        daemon.send_signal(signal.SIGSTOP)
                        time.sleep(0.8)
                        daemon.send_signal(signal.SIGCONT)
                        time.sleep(0.4)
                    while not loads.empty() or not held_up:
                        found, message = loads.get(timeout=LIMIT_S)
                        if found == level:
                            return message
                raise AssertionError(f"level {level} not within {LIMIT_S} s")

            until(0, held_up=False)
            before = len(poses)
            assert "left out: map detail, loop search, matching" in until(3, held_up=True)
            # All frames of that time have their poses, three seconds of 25 a second and more.
            assert len(poses) - before > 50
            assert until(0, held_up=False) == "keeps up"
        text = (tmp_path / "log").read_text()
        assert "left out: map detail, loop search" in text
        assert "Traceback" not in text
    finally:
        for process in (daemon, robot):
            if process is not None:
                process.kill()
                process.wait()


def test_what_is_left_out_is_left_out_and_taken_up_again() -> None:
    inputs = prepare(Path(__file__).parent / "recordings" / "scenario-3.mcap", None)
    pipeline = build_pipeline(inputs.configuration, inputs.layout, inputs.model, "synchronous", None, None)
    scans = pipeline._scan_odometry
    assert scans is not None
    searched: dict[Shed, set[bool]] = {level: set() for level in Shed}
    matched: dict[Shed, int] = dict.fromkeys(Shed, 0)
    frames = 0
    for device, measurement in inputs.recording:
        for result in pipeline.add(device, measurement):
            frames += 1
            level = pipeline.shed
            if result.keyframe is not None:
                searched[level].add(result.keyframe.searched)
            matched[level] += scans.matches
            pipeline.shed = Shed(frames // 250 % 4)
            matched[pipeline.shed] -= scans.matches
        if frames > 1500:
            break
    matched[pipeline.shed] += scans.matches
    assert searched[Shed.NOTHING] == searched[Shed.MAP_DETAIL] == {True}
    assert searched[Shed.LOOP_SEARCH] == searched[Shed.MATCHING] == {False}
    assert matched[Shed.MATCHING] == 0
    assert min(matched[level] for level in Shed if level < Shed.MATCHING) > 0
