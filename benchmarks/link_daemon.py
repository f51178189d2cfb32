"""The daemon itself for remote_link.py: a recording's devices on pseudo-terminals, and a configuration with keys."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from types import TracebackType

from benchmarks.link_namespaces import ROBOT
from benchmarks.link_scenario import PORT, Scenario
from sim_backend.configuration_writer import CONFIGURATION
from sim_backend.demo import program

LOCAL = "tcp/127.0.0.1:7447"
START_S, END_S = 60.0, 20.0


class SimulatedDaemon:
    """Serves a recording as long as the context lasts; without one, does nothing."""

    def __init__(self, recording: Path | None) -> None:
        self._recording = recording
        self._devices: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> SimulatedDaemon:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._devices is None:
            return
        self._devices.terminate()
        try:
            self._devices.wait(END_S)
        except subprocess.TimeoutExpired:
            self._devices.kill()
            self._devices.wait()

    def command(self, scenario: Scenario, folder: Path) -> list[str]:
        """Start the devices, and give the daemon's command line."""
        out = folder / "sim"
        serve = program("simulate", "--from", str(self._recording), "--out", str(out), "--listen", LOCAL)
        with (folder / "devices.log").open("wb") as log:
            self._devices = subprocess.Popen(serve, stdout=log, stderr=subprocess.STDOUT)
        path, end = out / CONFIGURATION, time.monotonic() + START_S
        while not path.exists():
            if self._devices.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"the devices did not start: {(folder / 'devices.log').read_text()[-400:]}")
            time.sleep(0.05)
        secured = f'["{LOCAL}", "tls/{ROBOT}:{PORT}"]\ncredentials = "{scenario.robot_bundle}"'
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace(f'["{LOCAL}"]', secured), encoding="utf-8")
        return program("run", "--config", str(path))
