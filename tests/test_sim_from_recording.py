"""A recording served by the same devices, and a recording with other odometry noise."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from drivers.measurement import HallFrame, OdometrySample
from drivers.recording_reader import Recording
from drivers.serial_reader import SerialReader
from drivers.settings import DeviceSettings
from robominer_slam.cli.evaluate import read_tum
from sim_backend.demo import program
from sim_backend.events import EncoderEvent, ImuEvent, OdometryEvent, TruthEvent, WhiskerEvent
from sim_backend.recorded_drive import events_of
from tests.test_serial_reader import first


def run(*arguments: str, expect: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(program(*arguments), capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == expect, done.stderr
    return done


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    run("simulate", "--max-time", "4", "--out", str(folder), "--record", str(folder / "drive.mcap"))
    return folder / "drive.mcap"


def odometry_of(path: Path) -> np.ndarray:
    return np.array([m.velocity for _, m in Recording(path) if isinstance(m, OdometrySample)])


def test_events_of_a_recording_are_those_that_made_it(recorded):
    events = list(events_of(Recording(recorded), 4096))
    counts = {kind: sum(isinstance(event, kind) for event in events)
              for kind in (WhiskerEvent, ImuEvent, EncoderEvent, OdometryEvent, TruthEvent)}  # fmt: skip
    assert counts == {WhiskerEvent: 100, ImuEvent: 400, EncoderEvent: 200, OdometryEvent: 119, TruthEvent: 100}
    ready = [event.ready_ns for event in events]
    assert ready == sorted(ready)
    frames = [m for _, m in Recording(recorded) if isinstance(m, HallFrame)]
    first_frame = next(event for event in events if isinstance(event, WhiskerEvent))
    np.testing.assert_array_equal(first_frame.field_mT, frames[0].field_mT.reshape(-1, 3))
    assert first_frame.time_ns == 0


def test_another_odometry_seed_changes_the_odometry_and_nothing_else(recorded, tmp_path):
    for seed in (7, 8):
        run("simulate", "--from", str(recorded), "--odometry-seed", str(seed), "--out", str(tmp_path / f"{seed}.mcap"))
    seven, eight, own = (odometry_of(path) for path in (tmp_path / "7.mcap", tmp_path / "8.mcap", recorded))
    assert abs(len(seven) - len(own)) <= 2
    assert not np.allclose(seven[:100], eight[:100])
    again, before = Recording(tmp_path / "7.mcap"), Recording(recorded)
    assert again.metadata["odometry_seed"] == "7"
    assert again.attachments() == before.attachments()
    assert again.sensor_period_ns == before.sensor_period_ns == 600_000
    kept = [(raw.topic, raw.data) for raw in again.raw_messages() if raw.topic != "odometry/twist"]
    assert kept == [(raw.topic, raw.data) for raw in before.raw_messages() if raw.topic != "odometry/twist"]
    times = [raw.log_time_ns for raw in again.raw_messages()]
    assert times == sorted(times)
    run("simulate", "--from", str(recorded), "--odometry-seed", "7", "--out", str(tmp_path / "folder"), expect=2)


def test_a_recording_is_served_on_ports_like_a_simulated_robot(recorded, tmp_path):
    command = program("simulate", "--from", str(recorded), "--out", str(tmp_path), "--json", "--rate", "2")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        settings = [DeviceSettings(name, ready["ports"][name]) for name in ("whiskers", "imu", "screws")]
        with SerialReader(settings) as reader:
            frame = first(reader, HallFrame, 15)
            assert process.wait(30) == 0
        assert isinstance(frame, HallFrame)
        assert frame.field_mT.shape == (8, 8, 3)
        assert len(read_tum(tmp_path / "ground_truth.txt")) == 100
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def test_a_recording_without_calibration_is_refused_with_one_line(tmp_path):
    from drivers.recording_writer import RecordingWriter

    with RecordingWriter(tmp_path / "bare.mcap", sensor_period_us=0) as writer:
        writer.write_measurement(OdometrySample(1, np.zeros(3)), 1)
    done = run("simulate", "--from", str(tmp_path / "bare.mcap"), "--out", str(tmp_path / "x"), expect=2)
    assert "carries no layout.json and no calibration.json" in done.stderr
