"""The daemon is killed in the middle of its work and started again: it finds its place in its map and goes on."""

from __future__ import annotations

import json
import os
import queue
import signal
import sqlite3
import subprocess
import time
from pathlib import Path

import numpy as np

from robominer_slam.cli.evaluate import read_tum
from robominer_slam.publishing.zenoh_session import ZenohBus
from sim_backend.demo import free_port, program
from tests.test_end_to_end import Heard, ask, connect, subscribe, wait_until

FIRST_LAP = ((0.7, 0.0, 0), (0.7, 0.3, 0), (0.1, 0.3, 0), (0.1, 0.0, 0))
SECOND_LAP = ((0.7, 0.05, 0), (0.7, 0.3, 0), (0.0, 0.3, 0))


def drive(folder: Path, waypoints: tuple[tuple[float, float, int], ...]) -> None:
    """Send the robot along, and wait until it has arrived."""
    arrives = 0.0
    for x, y, heading in waypoints:
        done = subprocess.run(
            program("waypoint", str(x), str(y), str(heading), "--out", str(folder)),
            capture_output=True, text=True, timeout=30, check=True,
        )  # fmt: skip
        start, arrives = (float(done.stdout.split()[k]) for k in (2, 5))
        if waypoints[0] == (x, y, heading):
            begin = start
    time.sleep(arrives - begin)


def state(heard: Heard) -> str:
    """Localisation's state as status tells it now."""
    while not heard.status.empty():
        heard.status.get()
    try:
        return heard.status.get(timeout=5)["localization"]["localization.state"]
    except queue.Empty:
        return "silent"


def graph(bus: ZenohBus) -> dict:
    return json.loads(ask(bus, "map/graph"))


def run(folder: Path, log: str) -> subprocess.Popen[bytes]:
    with (folder / log).open("wb") as out:
        return subprocess.Popen(
            program("run", "--config", str(folder / "config.toml")), stderr=out,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip


def test_a_killed_daemon_goes_on_with_its_map_when_it_is_started_again(tmp_path: Path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    simulate = program(
        "simulate", "--scenario", "0", "--engine", "quasi-static", "--method", "robust", "--out", str(tmp_path),
        "--listen", endpoint, "--json",
    )  # fmt: skip
    simulator = subprocess.Popen(simulate, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    children = [simulator]
    try:
        assert simulator.stdout is not None
        ready = json.loads(simulator.stdout.readline())
        config = tmp_path / "config.toml"
        config.write_text(config.read_text().replace('method = "robust"', 'method = "robust"\nstart = "continue"'))
        children.append(run(tmp_path, "first.log"))
        heard = Heard()
        with connect(endpoint) as bus:
            subscribe(bus, heard)
            wait_until(lambda: len(heard.pose) > 10, 30, "the poses")
            drive(tmp_path, FIRST_LAP)
            time.sleep(3.0)  # what may be lost at the most: [store] sync_s and the back-end's latency
            before = graph(bus)
            assert state(heard) == "tracking"
        assert len(before["keyframes"]) >= 5
        children[-1].send_signal(signal.SIGKILL)
        children[-1].wait(10)

        children.append(run(tmp_path, "second.log"))
        heard = Heard()
        with connect(endpoint) as bus:
            subscribe(bus, heard)
            wait_until(lambda: len(heard.pose) > 10, 30, "the poses after the restart")
            assert state(heard) == "relocalizing"
            assert all(np.sqrt(covariance[0, 0]) >= 10.0 for _, _, covariance in heard.pose)
            loaded = graph(bus)
            assert [k["id"] for k in loaded["keyframes"]] == [k["id"] for k in before["keyframes"]]
            for old, new in zip(before["keyframes"], loaded["keyframes"], strict=True):
                np.testing.assert_allclose(old["pose"], new["pose"], atol=0.002)
            refused = json.loads(bus.get("cmd/localize", {"x": "40", "y": "0", "yaw": "0"})[0].payload)
            assert not refused["ok"]
            assert "from the nearest place of the map" in refused["message"]
            told = json.loads(bus.get("cmd/localize", {"x": "0.2", "y": "0.1", "yaw": "0", "sigma": "0.3"})[0].payload)
            assert told["ok"], told
            assert state(heard) == "relocalizing"
            drive(tmp_path, SECOND_LAP)
            wait_until(lambda: state(heard) == "tracking", 10, "the place in the map")
            after = graph(bus)
            stamp, pose, covariance = heard.pose[-1]
        assert np.sqrt(covariance[0, 0]) < 0.1
        truth = read_tum(Path(ready["truth"]))
        nearest = int(np.abs(truth.stamps_ns - stamp).argmin())
        assert np.hypot(*(truth.T[nearest, :2, 3] - pose[:2, 3])) < 0.06
        ids = [k["id"] for k in after["keyframes"]]
        assert ids == sorted(set(ids))
        assert len(ids) >= len(before["keyframes"]) + 3
        children[-1].terminate()
        assert children[-1].wait(20) == 0, (tmp_path / "second.log").read_text()
    finally:
        for child in children:
            if child.poll() is None:
                child.kill()
                child.wait(10)
    connection = sqlite3.connect(tmp_path / "map.db")
    stored = connection.execute("SELECT map_id, id FROM keyframes ORDER BY id").fetchall()
    connection.close()
    assert stored[: len(ids)] == [(1, k) for k in ids]
