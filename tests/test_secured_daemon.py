"""The daemon as a process, with keys: what arrives by TLS and on loopback, commands in its log, `status`, `doctor`."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from drivers.ros_messages import deserialize
from robominer_slam.cli.doctor import doctor
from robominer_slam.cli.status import status
from robominer_slam.configuration.file import load
from robominer_slam.configuration.reload import Reload
from robominer_slam.layout import to_json
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.report_messages import DIAGNOSTIC_ARRAY
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.security.authority import Authority
from robominer_slam.service import serve
from sim_backend.configuration_writer import configuration_text, framed_port, write_calibration
from sim_backend.demo import program
from tests.secured_robot import LIMIT_S, PREFIX, Inbox, free_ports
from tests.simulated_hall_array import small_layout


@dataclass
class Running:
    """A daemon whose devices are not there, which is enough for it to answer."""

    authority: Authority
    process: subprocess.Popen[bytes]
    log: Path
    tls: str
    tcp: str

    def client(self, name: str | None) -> ZenohBus:
        where = self.tcp if name is None else self.tls
        return ZenohBus(client_settings(where, name and self.authority.bundle(name), LIMIT_S), PREFIX)


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("daemon")
    authority = Authority.create(folder / "keys")
    for name, role in (("rm3", "robot"), ("alice", "operator"), ("bob", "viewer")):
        authority.issue(name, role)
    tls, tcp = free_ports(2)
    # Few whiskers: their calibration is not what takes the time here.
    write_calibration(folder, small_layout(), 1)
    (folder / "small.json").write_text(to_json(small_layout()))
    text = configuration_text(
        [framed_port(role, folder / role) for role in ("whiskers", "imu", "screws")], "small.json",
        ticks_per_turn=1000, mount_rpy_deg=(0.0, 0.0, 0.0), source="fused", method=None, store=folder / "map.db",
        listen=f"tcp/127.0.0.1:{tcp}",
    )  # fmt: skip
    secured = f'["tcp/127.0.0.1:{tcp}", "tls/127.0.0.1:{tls}"]\ncredentials = "keys/holders/rm3"'
    (folder / "config.toml").write_text(text.replace(f'["tcp/127.0.0.1:{tcp}"]', secured))
    log = folder / "run.log"
    with log.open("wb") as file:
        process = subprocess.Popen(program("run", "--config", str(folder / "config.toml")), stderr=file)
    running = Running(authority, process, log, f"tls/localhost:{tls}", f"tcp/127.0.0.1:{tcp}")
    end = time.monotonic() + 60
    try:
        # The device that is missing is said after the network stands.
        while "is not there" not in log.read_text():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < end
            time.sleep(0.05)
        yield running
    finally:
        process.terminate()
        assert process.wait(20) == 0


def statuses(bus: ZenohBus, seconds: float) -> list[tuple[float, bytes]]:
    """What comes on `status` within a time: seconds since the beginning, and the message."""
    inbox = Inbox(bus, "status")
    begun = time.monotonic()
    found: list[tuple[float, bytes]] = []
    while (now := time.monotonic() - begun) < seconds:
        found += [(now, received.payload) for received in inbox.waiting()]
        time.sleep(0.02)
    return found


def test_status_is_full_on_loopback_and_short_on_tls(daemon: Running):
    with daemon.client("bob") as remote, daemon.client(None) as local:
        far = Inbox(remote, "status")
        near = statuses(local, 12.5)
        short = [received.payload for received in far.waiting()]
    assert 10 <= len(near) <= 14, "once a second"
    for _, payload in near:
        entries = {entry.name for entry in deserialize(payload, DIAGNOSTIC_ARRAY).status}
        assert {"localization", "process", "store", "device/whiskers"} <= entries, "the short one stays away"
    # Three in greeting, and one ten seconds after; nothing changes meanwhile.
    assert 2 <= len(short) <= 5
    assert max(map(len, short)) <= 400
    message = deserialize(short[-1], DIAGNOSTIC_ARRAY)
    assert message.status[0].name == "localization"
    assert {v.key: v.value for v in message.status[0].values}["localization.state"] == "lost"
    assert message.status[1].name == "device/whiskers", "a device that is missing"


def test_a_change_reaches_the_remote_at_once(daemon: Running):
    with daemon.client("alice") as remote:
        far = Inbox(remote, "status")

        def paused(wanted: str) -> None:
            far.until(
                lambda received: (
                    {v.key: v.value for v in deserialize(received.payload, DIAGNOSTIC_ARRAY).status[0].values}["paused"]
                    == wanted
                )
            )

        paused("false")
        begun = time.monotonic()
        assert json.loads(remote.get("cmd/pause")[0].payload)["ok"]
        paused("true")
        assert json.loads(remote.get("cmd/resume")[0].payload)["ok"]
        paused("false")
        # Each waits for the next second.
        assert time.monotonic() - begun < 6.0


def test_commands_are_acknowledged_logged_by_name_and_safe_to_repeat(daemon: Running):
    with daemon.client("alice") as alice:
        first = alice.get("cmd/new_map", {"id": "n1"})[0].payload
        again = alice.get("cmd/new_map", {"id": "n1"})[0].payload
        other = json.loads(alice.get("cmd/resume", {"id": "n1"})[0].payload)
    assert json.loads(first)["ok"]
    assert first == again
    assert other["message"] == "mapping goes on", "an id means nothing to another command"
    lines = [line for line in daemon.log.read_text().splitlines() if "new_map" in line]
    assert ["from alice: a new map" in lines[0], "from alice: repeated" in lines[1]] == [True, True]
    assert len(lines) == 2


@pytest.mark.parametrize("command", [status, doctor])
def test_status_and_doctor_by_tls(daemon: Running, command: click.Command):
    bundle = str(daemon.authority.bundle("bob"))
    done = CliRunner().invoke(command, ["--connect", daemon.tls, "--credentials", bundle, "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.output)


def test_an_expired_certificate_is_said_and_the_robot_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    authority = Authority.create(tmp_path / "keys")
    authority.issue("rm3", "robot", 0)
    authority.issue("spare", "robot")
    tcp, tls = free_ports(2)
    for name, expected in (("rm3", 1), ("spare", 0)):
        caplog.clear()
        path = tmp_path / f"{name}.toml"
        path.write_text(
            f'[robot]\nrole = "drivers"\n[[device]]\nname = "imu"\nport = "{tmp_path / "imu"}"\n'
            f'[zenoh]\nlisten = ["tcp/127.0.0.1:{tcp}", "tls/127.0.0.1:{tls}"]\ncredentials = "keys/holders/{name}"\n'
        )
        stop = threading.Event()
        configuration = load(path)
        thread = threading.Thread(target=serve, args=(configuration, Reload(path, configuration), stop))
        thread.start()
        try:
            with ZenohBus(client_settings(f"tcp/127.0.0.1:{tcp}", None, LIMIT_S), PREFIX) as local:
                assert Inbox(local, "status").until(lambda _: True), "the robot speaks"
            if name == "spare":
                settings = client_settings(f"tls/localhost:{tls}", authority.bundle("spare"), LIMIT_S)
                with ZenohBus(settings, PREFIX) as board:
                    [message] = Inbox(board, "status").until(lambda _: True)
                    assert len(message.payload) <= 400
        finally:
            stop.set()
            thread.join(LIMIT_S)
        assert sum("expired at" in record.message for record in caplog.records) == expected
