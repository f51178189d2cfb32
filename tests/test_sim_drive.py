"""Whole simulated drives: events, recordings, and `simulate` as a process."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from calibration.file_format import from_text
from robominer_slam import layout as layouts
from sim_backend.cli import simulate as command
from sim_backend.configuration_writer import write_calibration
from sim_backend.events import EncoderEvent, ImuEvent, OdometryEvent, TruthEvent, WhiskerEvent
from sim_backend.robot import RobotSettings, build_robot
from sim_backend.screws import ScrewSettings
from sim_backend.simulate import SimulationSettings, record_drive

ROOT = Path(__file__).resolve().parents[1]


def short_drive(**changes):
    return list(build_robot(settings=RobotSettings(max_time=3.0, **changes)).events())


def of(kind, events):
    return [event for event in events if isinstance(event, kind)]


@pytest.fixture(scope="module")
def events():
    return short_drive()


def test_events_come_in_the_order_in_which_they_are_ready(events):
    ready = [event.ready_ns for event in events]
    assert ready == sorted(ready)


@pytest.mark.parametrize(
    ("kind", "count", "period_ns", "first"),
    [
        (WhiskerEvent, 75, 40_000_000, 0),
        (TruthEvent, 75, 40_000_000, 0),
        (ImuEvent, 300, 10_000_000, 0),
        (EncoderEvent, 150, 20_000_000, 0),
        (OdometryEvent, 89, 1e9 / 30, 33_333_333),
    ],
)
def test_every_sensor_keeps_its_rate(events, kind, count, period_ns, first):
    times = [event.time_ns for event in of(kind, events)]
    assert (len(times), times[0]) == (count, first)
    assert np.abs(np.diff(times) - period_ns).max() <= 1


def test_a_whisker_frame_is_ready_when_its_last_sensor_has_been_read(events):
    frame = of(WhiskerEvent, events)[3]
    assert frame.ready_ns - frame.time_ns == 64 * 600_000


def test_the_robot_starts_at_the_origin_of_the_map(events):
    first = of(TruthEvent, events)[0]
    np.testing.assert_allclose(first.position, 0.0, atol=1e-12)
    np.testing.assert_allclose(first.orientation_xyzw, [0, 0, 0, 1], atol=1e-12)


def same(one, other):
    if isinstance(one, WhiskerEvent):
        return (one.field_mT == other.field_mT).all() and (one.truth.hinge == other.truth.hinge).all()
    if isinstance(one, ImuEvent):
        return (one.gyro == other.gyro).all() and (one.acceleration == other.acceleration).all()
    if isinstance(one, EncoderEvent):
        return (one.ticks == other.ticks).all()
    if isinstance(one, OdometryEvent):
        return (one.velocity == other.velocity).all()
    return (one.position == other.position).all()


def test_the_same_seed_gives_the_same_events(events):
    again = short_drive()
    assert len(again) == len(events)
    assert all(same(a, b) for a, b in zip(events, again, strict=True))


def test_another_seed_gives_other_sensors_in_the_same_motion(events):
    other = short_drive(seed=2)
    for kind in (WhiskerEvent, ImuEvent, EncoderEvent):
        assert not same(of(kind, events)[-1], of(kind, other)[-1]), kind
    for kind in (TruthEvent, OdometryEvent):
        assert same(of(kind, events)[-1], of(kind, other)[-1]), kind
    hinge = [of(WhiskerEvent, drive)[-1].truth.hinge for drive in (events, other)]
    assert (hinge[0] == hinge[1]).all()


def test_another_odometry_seed_changes_nothing_but_the_odometry(events):
    other = short_drive(odometry_seed=1)
    for one, two in zip(events, other, strict=True):
        assert same(one, two) != isinstance(one, OdometryEvent)


def test_ideal_screws_count_the_distance_driven():
    ideal = ScrewSettings(slip=(0.0, 0.0), internal_slip=0.0, noise=0.0)
    robot = build_robot(settings=RobotSettings(max_time=5.0, screws=ideal))
    events = list(robot.events())
    w = of(EncoderEvent, events)[-1].angle
    moved = 0.078 * np.tan(np.deg2rad(30)) / 4 * (-w[0] - w[1] + w[2] + w[3])
    last = of(EncoderEvent, events)[-1].time_ns * 1e-9
    assert moved == pytest.approx(robot.motion.at([last]).position[0, 0], abs=2e-4)


def record(folder, name, **changes):
    settings = SimulationSettings(out=folder, robot=RobotSettings(max_time=1.0, **changes))
    counts = record_drive(settings, folder / name)
    return counts, (folder / name).read_bytes()


def test_recordings_hold_everything_and_are_the_same_for_the_same_seed(tmp_path, monkeypatch):
    # One array, one fit.
    fitted = functools.cache(lambda seed: write_calibration(tmp_path, layouts.thesis_grid(), seed))
    monkeypatch.setattr("sim_backend.simulate.write_calibration", lambda _folder, _layout, seed: fitted(seed))
    counts, first = record(tmp_path, "one.mcap")
    expected = {"whiskers": 25, "imu": 100, "screws": 50, "odometry/twist": 29, "ground_truth": 25}
    assert counts == {**expected, "ground_truth/whiskers": 25}
    (tmp_path / "elsewhere").mkdir()
    assert record(tmp_path / "elsewhere", "two.mcap")[1] == first
    assert record(tmp_path, "three.mcap", odometry_seed=1)[1] != first
    with (tmp_path / "one.mcap").open("rb") as file:
        reader = make_reader(file)
        attachments = {item.name: item.data.decode() for item in reader.iter_attachments()}
        metadata = {item.name: item.metadata for item in reader.iter_metadata()}
        messages = [(channel.topic, m.log_time, m.publish_time) for _, channel, m in reader.iter_messages()]
    assert metadata["robominer_slam"]["sensor_period_us"] == "600"
    assert layouts.from_json(attachments["layout.json"], "").name == "thesis-grid"
    assert from_text(attachments["calibration.json"], "").layout == "thesis-grid"
    assert {device["name"] for device in tomllib.loads(attachments["config.toml"])["device"]} == {
        "whiskers",
        "imu",
        "screws",
    }
    assert str(tmp_path) not in attachments["config.toml"]
    # Whiskers are logged when they arrive, and stamped with their first sensor's reading.
    delays = {log - publish for topic, log, publish in messages if topic == "whiskers"}
    assert delays == {64 * 600_000 + 1_000_000}


def start(folder, *options):
    code = "from sim_backend.cli import simulate; simulate()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "--out", str(folder), "--json", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    line = process.stdout.readline()
    assert line, process.stderr.read()
    return process, json.loads(line)


def test_simulate_drives_without_a_host_and_ends(tmp_path):
    process, ready = start(tmp_path, "--max-time", "0.4", "--wait", "0")
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    done = json.loads(out.splitlines()[-1])
    assert done["event"] == "done"
    assert not done["host_came"]
    assert set(ready["ports"]) == {"whiskers", "imu", "screws", "odometry"}
    truth = np.loadtxt(ready["truth"])
    assert truth.shape == (10, 8)
    assert abs(truth[0, 0] - time.time()) < 60.0
    configuration = tomllib.loads(Path(ready["configuration"]).read_text())
    assert configuration["device"][0]["port"] == ready["ports"]["whiskers"]
    assert (tmp_path / "jig.csv").is_file()
    assert not Path(ready["ports"]["imu"]).is_symlink()


def test_simulate_ends_cleanly_on_sigterm(tmp_path):
    process, ready = start(tmp_path)
    assert Path(ready["ports"]["whiskers"]).is_symlink()
    process.send_signal(signal.SIGTERM)
    out, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert json.loads(out.splitlines()[-1])["stopped"]
    assert not Path(ready["ports"]["whiskers"]).is_symlink()


@pytest.mark.parametrize(
    "options",
    [["--scenario", "9"], ["--world", "moon"], ["--engine", "magic"], ["--rate", "0"]],
)
def test_wrong_options_are_one_clear_error(tmp_path, options):
    result = CliRunner().invoke(command, ["--out", str(tmp_path), *options])
    assert result.exit_code == 2
    assert "expected one of" in result.output or "is not" in result.output
    assert "Traceback" not in result.output


def test_help_has_an_example():
    assert "simulate --scenario 1" in CliRunner().invoke(command, ["--help"]).output
