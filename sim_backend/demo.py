"""simulate + run + a listener + the operator's console, each a process of its own; then the report.

All figures come from what went over Zenoh, from /proc, and from the simulator's truth.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
from rich.console import Console
from rich.live import Live

from sim_backend.demo_report import write_report
from sim_backend.live_view import LiveView
from sim_backend.process_usage import ProcessUsage, usage_of

#: What the operator's console says when its page can be opened.
PAGE = "operator's console:"
STARTUP_TIMEOUT_S = 60.0
ENDING_TIMEOUT_S = 30.0
REFRESH_S = 0.5
#: Where there is no terminal, a line this often.
LINE_INTERVAL_S = 10.0


@dataclass(frozen=True)
class DemoSettings:
    """What the demo is asked for; see the command's options."""

    out: Path
    scenario: int
    seed: int
    method: str
    max_time: float | None
    record: bool
    as_json: bool
    operator_port: int | None = None


class DemoError(click.ClickException):
    """A process of the demo did not do its part."""


@dataclass
class Child:
    """A process of the demo and its log."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def wait_until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until the condition holds, while the process lives.

        Raises:
            DemoError: the process ended, or it took too long.
        """
        end = time.monotonic() + STARTUP_TIMEOUT_S
        while not condition():
            self.check()
            if time.monotonic() > end:
                raise DemoError(f"{self.name}: {what} not within {STARTUP_TIMEOUT_S:g} s; see {self.log}")
            time.sleep(0.05)

    def check(self) -> None:
        """Raise DemoError with the end of its log if the process has failed."""
        if self.process.poll() not in (None, 0):
            tail = self.log.read_text(encoding="utf-8", errors="replace")[-2000:]
            raise DemoError(f"{self.name} ended with {self.process.returncode}; the end of {self.log}:\n{tail}")

    def end(self) -> None:
        """Ask it to end (SIGTERM), and wait.

        Raises:
            DemoError: it did not end, or with a failure.
        """
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(ENDING_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise DemoError(
                f"{self.name} did not end within {ENDING_TIMEOUT_S:g} s of SIGTERM; see {self.log}"
            ) from None
        self.check()


@contextlib.contextmanager
def started(name: str, arguments: Sequence[str], log: Path) -> Iterator[Child]:
    """A process whose stdout and stderr go to a file; killed on leaving if it still runs."""
    with log.open("wb") as file:
        process = subprocess.Popen(arguments, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
    try:
        yield Child(name, process, log)
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


def free_port() -> int:
    """A TCP port of loopback that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def program(*arguments: str) -> list[str]:
    """This program's command line, run by this interpreter."""
    return [sys.executable, "-c", "from robominer_slam.cli.main import main; main()", *arguments]


def simulate_arguments(settings: DemoSettings, robot: Path, endpoint: str) -> list[str]:
    """The simulator's command line."""
    arguments = ["simulate", "--world", "thesis", "--scenario", str(settings.scenario), "--engine", "physics"]
    arguments += ["--seed", str(settings.seed), "--method", settings.method]
    arguments += ["--out", str(robot), "--listen", endpoint, "--zenoh-waypoints", "--json"]
    if settings.max_time is not None:
        arguments += ["--max-time", str(settings.max_time)]
    return arguments


def run_demo(settings: DemoSettings) -> None:
    """Run everything, show it, write the report; ends by itself.

    Raises:
        DemoError: a process failed; the message has the end of its log.
    """
    begin = time.monotonic()
    out = settings.out
    robot = out / "robot"
    robot.mkdir(parents=True, exist_ok=True)
    (robot / "map.db").unlink(missing_ok=True)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    console = Console(stderr=True)
    operator: Child | None = None
    with contextlib.ExitStack() as stack:
        console.print("simulated robot: physics, magnets, sensors ...", highlight=False)
        simulate = program(*simulate_arguments(settings, robot, endpoint))
        simulator = stack.enter_context(started("simulate", simulate, out / "simulate.log"))
        simulator.wait_until(lambda: '"event": "ready"' in simulator.log.read_text(encoding="utf-8"), "its devices")
        ready = next(json.loads(s) for s in simulator.log.read_text(encoding="utf-8").splitlines() if s[:1] == "{")
        listening = [sys.executable, "-m", "sim_backend.listener", "--connect", endpoint, "--out", str(out)]
        run = program("run", "--config", str(ready["configuration"]))
        # The listener keeps trying until the daemon listens; the robot drives off when the daemon reads its ports.
        listener = stack.enter_context(started("listener", listening, out / "listener.log"))
        daemon = stack.enter_context(started("run", run, out / "run.log"))
        if settings.operator_port is not None:
            operator = stack.enter_context(operator_console(settings.operator_port, endpoint, out, console))
        listener.wait_until(lambda: "listening" in listener.log.read_text(encoding="utf-8"), "the daemon on Zenoh")
        if operator is not None:
            operator.wait_until(lambda: PAGE in operator.log.read_text(encoding="utf-8"), "the operator's page")
            line = next(s for s in operator.log.read_text(encoding="utf-8").splitlines() if PAGE in s)
            console.print(line, highlight=False, soft_wrap=True)
        usage = _watch(settings, console, Path(ready["truth"]), float(ready["duration"]), simulator, daemon)
        listener.end()
        if operator is not None:
            operator.end()
        daemon.end()
    write_report(out, Path(ready["truth"]), settings.scenario, usage, settings.as_json)
    if settings.record:
        console.print("recording the same drive ...", highlight=False)
        recording = simulate_arguments(settings, robot, endpoint)
        subprocess.run(program(*recording, "--record", str(out / "drive.mcap")), check=True, stdout=subprocess.DEVNULL)
    console.print(f"{time.monotonic() - begin:.0f} s; figures and trajectories are in {out}/", highlight=False)


def operator_console(
    port: int, endpoint: str, out: Path, console: Console
) -> contextlib.AbstractContextManager[Child | None]:
    """The operator's console as a process; None, and a word about it, where its libraries are not installed."""
    if importlib.util.find_spec("nicegui") is None:
        console.print("no operator's console: pip install 'robominer-slam[operator]'", highlight=False)
        return contextlib.nullcontext()
    # A browser comes up only for someone who sits here.
    display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    browse = "--open" if console.is_terminal and display else "--no-open"
    arguments = ["operator", "--connect", endpoint, "--timeout", str(STARTUP_TIMEOUT_S), browse]
    arguments += ["--port", str(port if port_is_free(port) else 0)]
    return started("operator", program(*arguments), out / "operator.log")


def port_is_free(port: int) -> bool:
    """Whether a TCP port of loopback can be listened on now."""
    try:
        with socket.create_server(("127.0.0.1", port)):
            return True
    except OSError:
        return False


def _watch(
    settings: DemoSettings, console: Console, truth: Path, duration: float, simulator: Child, daemon: Child
) -> ProcessUsage:
    """Show the drive until it is over and the last pose has come; returns what the daemon has used."""
    view = LiveView(truth, settings.out / "slam.tum", settings.out / "odometry.tum", duration)
    next_line = time.monotonic() + LINE_INTERVAL_S
    live = Live(console=console, get_renderable=view.render, refresh_per_second=2, transient=True)
    frames, quiet = -1, 0
    with contextlib.closing(view), live if console.is_terminal else contextlib.nullcontext():
        while simulator.process.poll() is None or quiet < 2:
            time.sleep(REFRESH_S)
            daemon.check()
            view.update()
            # After the robot has stopped, the poses still on their way are waited for.
            quiet = quiet + 1 if view.frames() == frames else 0
            frames = view.frames()
            if not console.is_terminal and time.monotonic() >= next_line:
                next_line += LINE_INTERVAL_S
                console.print(view.line(), highlight=False, soft_wrap=True)
        simulator.check()
    return usage_of(daemon.process.pid)
