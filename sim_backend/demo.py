"""simulate + run + a listener, each a process of its own; then the report.

All figures come from what went over Zenoh, from /proc, and from the simulator's truth.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.live import Live

from robominer_slam.cli.evaluate import print_report, read_tum
from robominer_slam.evaluation.report import DriveReport, drive_report
from robominer_slam.mapping.height_grid import height_grid
from sim_backend.live_view import LiveView
from sim_backend.process_usage import ProcessUsage, usage_of

STARTUP_TIMEOUT_S = 60.0
ENDING_TIMEOUT_S = 60.0
REFRESH_S = 0.5
#: Where there is no terminal, a line this often.
LINE_INTERVAL_S = 10.0
#: Cells of the height map in the figure, m.
FIGURE_CELL = 0.02


@dataclass(frozen=True)
class DemoSettings:
    """What the demo is asked for; see the command's options."""

    out: Path
    scenario: int
    seed: int
    method: str
    max_time_s: float | None
    record: bool


class DemoError(click.ClickException):
    """A process of the demo did not do its part."""


def free_port() -> int:
    """A TCP port of loopback that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def process(arguments: Sequence[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process whose stdout and stderr go to a file; ended with SIGTERM, then SIGKILL, at the latest on leaving."""
    with log.open("wb") as file:
        child = subprocess.Popen(arguments, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        try:
            yield child
        finally:
            if child.poll() is None:
                child.send_signal(signal.SIGTERM)
                try:
                    child.wait(ENDING_TIMEOUT_S)
                except subprocess.TimeoutExpired:
                    child.kill()
                    child.wait()


def wait_for(condition: object, child: subprocess.Popen[bytes], log: Path, what: str) -> None:
    """Wait until `condition()` holds while the process lives."""
    end = time.monotonic() + STARTUP_TIMEOUT_S
    while not condition():  # type: ignore[operator]
        if child.poll() is not None:
            raise DemoError(f"{what}: the process ended with {child.returncode}; its log:\n{log.read_text()[-2000:]}")
        if time.monotonic() > end:
            raise DemoError(f"{what}: not within {STARTUP_TIMEOUT_S:g} s; see {log}")
        time.sleep(0.05)
