"""One board with the drivers, another with the SLAM, Zenoh between them; and what `status` prints of both."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import numpy as np

from robominer_slam.cli.evaluate import read_tum
from robominer_slam.evaluation.metrics import trajectory_errors
from robominer_slam.evaluation.trajectory import Trajectory
from sim_backend.demo import free_port, program
from tests.test_end_to_end import Heard, connect, subscribe, wait_until

DRIVE_S = 8.0


def board(folder: Path, name: str, text: str, port: int) -> list[str]:
    """The command line of a daemon with its own configuration."""
    config = folder / f"{name}.toml"
    lines = [f'listen = ["tcp/127.0.0.1:{port}"]' if line.startswith("listen") else line for line in text.splitlines()]
    config.write_text("\n".join(lines))
    return program("run", "--config", str(config))


def test_the_devices_of_one_board_serve_the_slam_of_another(tmp_path: Path):
    ports = free_port(), free_port()
    simulate = program("simulate", "--max-time", str(DRIVE_S), "--out", str(tmp_path), "--json")
    simulator = subprocess.Popen(simulate, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    children = [simulator]
    try:
        assert simulator.stdout is not None
        ready = json.loads(simulator.stdout.readline())
        text = Path(ready["configuration"]).read_text()
        slam = text.replace('role = "all"', 'role = "slam"')
        drivers = text.replace('role = "all"', 'role = "drivers"').replace(
            "connect = []", f'connect = ["tcp/127.0.0.1:{ports[0]}"]'
        )
        children.append(subprocess.Popen(board(tmp_path, "slam", slam, ports[0]), stderr=subprocess.DEVNULL))
        heard = Heard()
        with connect(f"tcp/127.0.0.1:{ports[0]}") as bus:
            subscribe(bus, heard)
            children.append(subprocess.Popen(board(tmp_path, "drivers", drivers, ports[1]), stderr=subprocess.DEVNULL))
            assert simulator.wait(DRIVE_S + 60) == 0
            wait_until(lambda: len(heard.pose) > 0.8 * 25 * DRIVE_S, 10, "the poses")
            printed = subprocess.run(
                program("status", "--connect", f"tcp/127.0.0.1:{ports[0]}", "--json"),
                capture_output=True, text=True, timeout=30, check=False,
            )  # fmt: skip
            assert printed.returncode == 0, printed.stderr
            names = {entry["name"] for entry in json.loads(printed.stdout)}
            assert {"device/whiskers", "device/imu", "device/screws"} <= names
        poses = heard.pose
        estimate = Trajectory(np.array([s for s, _, _ in poses]), np.array([T for _, T, _ in poses]))
        errors = trajectory_errors(estimate, read_tum(Path(ready["truth"])))
        assert errors.position.mean() < 0.06
        assert len(heard.contacts) > 0
        assert np.median(heard.contacts) > 48
    finally:
        for child in children[::-1]:
            if child.poll() is None:
                child.terminate()
        for child in children:
            child.wait(30)
    assert [child.returncode for child in children[1:]] == [0, 0]


def test_status_without_a_daemon_says_so():
    start = time.monotonic()
    done = subprocess.run(
        program("status", "--connect", f"tcp/127.0.0.1:{free_port()}", "--timeout", "1"),
        capture_output=True, text=True, timeout=30, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "is the robot's program running?" in done.stderr
    assert time.monotonic() - start < 20
