"""`record --config`: raw sensors from simulated devices, or from the daemon that has them; `replay` runs on both."""

from __future__ import annotations

import json
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.measurement import HallFrame
from drivers.recording_reader import Recording
from robominer_slam.configuration.file import load
from sim_backend.demo import free_port, program
from tests.test_end_to_end import connect, wait_until

SECONDS = 2.2
TOPICS = {"whiskers", "imu", "screws"}


def listening_elsewhere(text: str) -> str:
    """A configuration's text with a port that is free."""
    return re.sub(r"^listen = .*$", f'listen = ["tcp/127.0.0.1:{free_port()}"]', text, flags=re.MULTILINE)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("robot")
    simulate = program("simulate", "--max-time", "60", "--out", str(folder), "--json")
    with subprocess.Popen(simulate, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as simulator:
        assert simulator.stdout is not None
        path = Path(json.loads(simulator.stdout.readline())["configuration"])
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        lines = [
            f'listen = ["{endpoint}"]' if one.startswith("listen") else one for one in path.read_text().splitlines()
        ]
        path.write_text("\n".join(lines) + "\n")
        yield path
        simulator.kill()


def recorded(config: Path, out: Path, said: str) -> Recording:
    done = subprocess.run(
        program("record", "--config", str(config), "--out", str(out), "--max-time", str(SECONDS), "--json"),
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert said in done.stderr
    summary = json.loads(done.stdout)
    assert set(summary["counts"]) == TOPICS
    # Devices need a moment to open and to synchronise their clocks.
    assert summary["counts"]["whiskers"] > 25 * (SECONDS - 1.7)
    assert summary["dropped"] == 0
    recording = Recording(out)
    assert recording.complete
    assert recording.sensor_period_ns > 0
    assert abs(next(iter(recording))[0] - time.time_ns()) < 120e9
    attachments = recording.attachments()
    assert attachments["config.toml"] == config.read_bytes()
    assert {"layout.json", "calibration.json"} <= attachments.keys()
    return recording


def replayed(out: Path, folder: Path) -> int:
    done = subprocess.run(
        program("replay", str(out), "--tum", str(folder / "slam.tum"), "--json"),
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["dropped"] == 0
    return int(summary["frames"])


def test_devices_are_recorded_and_replay_runs_on_it(config: Path, tmp_path: Path) -> None:
    recording = recorded(config, tmp_path / "drive.mcap", "recording 3 devices")
    assert replayed(tmp_path / "drive.mcap", tmp_path) == recording.topics["whiskers"].count


def test_the_daemon_hands_on_what_its_devices_measure(config: Path, tmp_path: Path) -> None:
    daemon = subprocess.Popen(program("run", "--config", str(config)), stderr=subprocess.DEVNULL)
    try:
        heard: list[object] = []
        [endpoint] = load(config).zenoh.listen
        with connect(endpoint) as bus:
            bus.subscriber("pose", heard.append)
            wait_until(lambda: len(heard) > 5, 20, "the poses")
        recording = recorded(config, tmp_path / "drive.mcap", "what the daemon's devices measure")
    finally:
        daemon.terminate()
        assert daemon.wait(20) == 0
    # Each frame once, in its order: what the daemon hands on is what it takes itself.
    stamps = [m.stamp_ns for _, m in recording if isinstance(m, HallFrame)]
    assert len(stamps) == recording.topics["whiskers"].count
    assert np.median(np.diff(stamps)) == pytest.approx(40e6, rel=0.05)
    assert min(np.diff(stamps)) > 0


def test_a_recording_that_nothing_came_to_is_said_and_not_kept(config: Path, tmp_path: Path) -> None:
    text = config.read_text().replace("/dev/", "/gone/")
    elsewhere = tmp_path / "config.toml"
    lines = [
        f'listen = ["tcp/127.0.0.1:{free_port()}"]' if one.startswith("listen") else one for one in text.splitlines()
    ]
    elsewhere.write_text("\n".join(lines).replace('"calibration.json"', f'"{config.parent / "calibration.json"}"'))
    out = tmp_path / "none.mcap"
    done = subprocess.run(
        program("record", "--config", str(elsewhere), "--out", str(out), "--max-time", "0.5"),
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "no device has sent anything" in done.stderr
    assert "is not there" in done.stderr
    assert not out.exists()
