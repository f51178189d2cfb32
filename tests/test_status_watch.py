"""`status --watch`: each message in the place of the one before, or a line for each."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from robominer_slam.configuration.zenoh_section import ZenohSection
from robominer_slam.publishing.report_messages import Diagnostic, Level, diagnostics
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.zenoh_session import ZenohBus
from sim_backend.demo import free_port, program
from tests.secured_robot import PREFIX

LIMIT_S = 20.0


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    """A daemon's voice: it counts ten times a second."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    stop = threading.Event()
    with ZenohBus(robot_settings(ZenohSection(listen=(endpoint,)), tmp_path, PREFIX), PREFIX) as bus:

        def speak() -> None:
            count = 0
            while not stop.wait(0.1):
                count += 1
                entry = Diagnostic("localization", Level.OK, f"heartbeat {count}", {"keyframes": str(count)})
                bus.put("status", diagnostics(count, [entry]))

        thread = threading.Thread(target=speak)
        thread.start()
        try:
            yield endpoint
        finally:
            stop.set()
            thread.join()


def test_a_line_of_json_for_each_message(endpoint: str):
    process = subprocess.Popen(
        program("status", "--connect", endpoint, "--watch", "--json"), stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        counts = [int(json.loads(process.stdout.readline())[0]["values"]["keyframes"]) for _ in range(4)]
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
    assert counts == list(range(counts[0], counts[0] + 4))


def test_it_is_refreshed_in_place(endpoint: str):
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        program("status", "--connect", endpoint, "--watch"), stdout=theirs, stderr=theirs,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "100", "LINES": "40"},
        # Whoever runs the tests in the background has them ignore Ctrl+C; a terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    os.close(theirs)
    shown, end = "", time.monotonic() + LIMIT_S
    try:
        while shown.count("heartbeat") < 4 and time.monotonic() < end:
            shown += os.read(ours, 65536).decode(errors="replace")
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(OSError):  # the terminal's end
            while select.select([ours], [], [], LIMIT_S)[0] and (more := os.read(ours, 65536)):
                shown += more.decode(errors="replace")
        assert process.wait(LIMIT_S) == 130
    finally:
        process.kill()
        process.wait()
        os.close(ours)
    assert "Traceback" not in shown
    # The cursor goes up again before each new picture: nothing is scrolled away.
    pictures = shown.count("heartbeat")
    assert pictures >= 4
    assert shown.count("\x1b[1A") >= pictures - 1
