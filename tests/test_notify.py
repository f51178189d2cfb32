"""The daemon as systemd sees it: the real program on a simulated robot, with the notify socket in the test's hands."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from robominer_slam.notify import Notifier
from sim_backend.demo import free_port, program

#: A busy machine takes its time; what is well takes a second.
LIMIT_S = 60.0
#: The daemon, whose publishing hangs while a file is there: a main loop that stands still.
HANGING = """
import pathlib, sys, time
from robominer_slam import publisher
frame, hang = publisher.Publisher.frame, pathlib.Path(sys.argv.pop())
def hanging(self, result, **options):
    while hang.exists():
        time.sleep(0.05)
    frame(self, result, **options)
publisher.Publisher.frame = hanging
from robominer_slam.cli.main import main
main()
"""


class Manager:
    """What systemd would hear."""

    def __init__(self, address: str) -> None:
        self.heard: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)

    def until(self, wanted: Callable[[str], bool], what: str) -> list[str]:
        """What comes up to a wanted message."""
        begin, end = len(self.heard), time.monotonic() + LIMIT_S
        while time.monotonic() < end:
            self._socket.settimeout(max(end - time.monotonic(), 0.01))
            with contextlib.suppress(TimeoutError):
                self.heard.append(self._socket.recv(4096).decode())
                if wanted(self.heard[-1]):
                    return self.heard[begin:]
        raise AssertionError(f"not heard: {what}; heard: {self.heard}")

    def during(self, seconds: float) -> list[str]:
        """What comes within so long."""
        begin, end = len(self.heard), time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._socket.settimeout(left)
            with contextlib.suppress(TimeoutError):
                self.heard.append(self._socket.recv(4096).decode())
        return self.heard[begin:]

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A simulated robot that is there, but does not say anything yet."""
    process = subprocess.Popen(
        program("simulate", "--scenario", "0", "--engine", "quasi-static", "--out", str(tmp_path), "--json",
                "--listen", f"tcp/127.0.0.1:{free_port()}"),
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())
        process.send_signal(signal.SIGSTOP)
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(str(tmp_path / "notify"))
    yield manager
    manager.close()


@pytest.fixture
def daemon(tmp_path: Path, robot: subprocess.Popen[bytes], manager: Manager) -> Iterator[subprocess.Popen[bytes]]:
    environment = {
        **os.environ, "OPENBLAS_NUM_THREADS": "1",
        "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "30000000",
    }  # fmt: skip
    environment.pop("WATCHDOG_PID", None)
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", HANGING, "run", "--config", str(tmp_path / "config.toml"), str(tmp_path / "hang")],
            stderr=log, env=environment,
        )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        assert "Traceback" not in (tmp_path / "log").read_text()


def logged(folder: Path, text: str) -> str:
    """The first line of the log with a text in it; waits for it."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        for line in (folder / "log").read_text().splitlines():
            if text in line:
                return line
        time.sleep(0.05)
    raise AssertionError((folder / "log").read_text())


def test_the_life_of_a_service(
    tmp_path: Path, robot: subprocess.Popen[bytes], daemon: subprocess.Popen[bytes], manager: Manager
):
    # Nothing flows yet: not ready, but it says what it waits for and asks for time; a silent sensor is no hang.
    heard = manager.until(lambda m: m.startswith("EXTEND_TIMEOUT_USEC="), "that the start takes longer")
    heard += manager.until(lambda m: "whiskers silent" in m, "that the whiskers are silent")
    heard += manager.until(lambda m: m == "WATCHDOG=1", "a sign of life")
    # Before READY there is no reload for systemd.
    daemon.send_signal(signal.SIGHUP)
    logged(tmp_path, "nothing has changed")
    heard += manager.during(0.5)
    assert any(m.startswith("STATUS=waiting for the first whisker frame") for m in heard)
    assert not [m for m in heard if m.startswith(("READY", "RELOADING"))]

    robot.send_signal(signal.SIGCONT)
    manager.until(lambda m: m == "READY=1", "ready")
    assert "first whisker frame: publishing poses" in (tmp_path / "log").read_text()
    manager.until(lambda m: m.startswith("STATUS=tracking") and " Hz, " in m, "the state in words")

    check_reloading(tmp_path, daemon, manager)

    # A main loop that stands still starves the watchdog.
    (tmp_path / "hang").touch()
    manager.during(1.0)  # what was on its way
    assert manager.during(2.5) == []
    (tmp_path / "hang").unlink()
    manager.until(lambda m: m == "WATCHDOG=1", "a sign of life")

    # The devices fall silent, then are unplugged: said at once, and no reason to be killed.
    robot.send_signal(signal.SIGSTOP)
    manager.until(lambda m: "whiskers silent" in m, "that the whiskers are silent")
    manager.until(lambda m: m == "WATCHDOG=1", "a sign of life")
    # The names go too: another test's terminal may get the number, and the daemon would take it for its own.
    for name in (tmp_path / "dev").iterdir():
        name.unlink()
    robot.kill()
    manager.until(lambda m: "whiskers absent" in m, "that the whiskers are gone")
    manager.until(lambda m: m == "WATCHDOG=1", "a sign of life")

    daemon.send_signal(signal.SIGTERM)
    manager.until(lambda m: m == "STOPPING=1", "the end")
    assert daemon.wait(LIMIT_S) == 0


def check_reloading(folder: Path, daemon: subprocess.Popen[bytes], manager: Manager) -> None:
    """What can change live does, what cannot is named; a broken file changes nothing."""

    def reload(text: str) -> None:
        config.write_text(text)
        daemon.send_signal(signal.SIGHUP)
        manager.until(lambda m: m.startswith("RELOADING=1\nMONOTONIC_USEC="), "reloading")
        manager.until(lambda m: m == "READY=1", "ready after the reload")

    config = folder / "config.toml"
    good = config.read_text()
    changed = good + '\n[map]\ngrid_cell = 0.07\n[contact]\nflow_whiskers = 9\n[log]\nlevel = "warning"\n'
    reload(changed)
    logged(folder, "reloaded: map.grid_cell = 0.07, was 0.05")
    assert "WARNING" in logged(folder, "contact.flow_whiskers has changed to 9: needs a restart")
    reload(good + "\n[map]\ngrid_cell = -1\n")
    assert "map.grid_cell: expected" in logged(folder, "not reloaded, the old configuration stays")
    before = (folder / "log").read_text().count("INFO")
    reload(changed.replace("0.07", "0.08"))
    assert (folder / "log").read_text().count("INFO") == before  # the level is in force


def test_without_systemd_nothing_is_sent():
    notifier = Notifier({})
    for say in (notifier.ready, notifier.alive, notifier.reloading, notifier.stopping):
        say()
    assert not notifier.watched


def test_a_deaf_manager_is_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "nobody"), "WATCHDOG_USEC": "1000000"})
    with contextlib.closing(notifier):
        notifier.ready()
        notifier.alive()
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "systemd cannot be told READY" in caplog.text


def test_an_abstract_socket_and_a_watchdog_of_another_process():
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(f"\0robominer-notify-{os.getpid()}")
        heard.settimeout(5.0)
        environment = {"NOTIFY_SOCKET": f"@robominer-notify-{os.getpid()}", "WATCHDOG_USEC": "1", "WATCHDOG_PID": "1"}
        with contextlib.closing(Notifier(environment)) as notifier:
            notifier.alive()
            notifier.status("two\nlines")
        assert heard.recv(100) == b"STATUS=two lines"
