"""A whisker array behind a pseudo-terminal whose whiskers a test holds as an operator would."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pty
import struct
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from cobs import cobs

from robominer_slam import layout as layouts
from robominer_slam.cli.main import main
from robominer_slam.layout import WhiskerLayout
from sim_backend.magnet import HallArray
from sim_backend.physics import hinge_angles
from tests.conftest import make_packet


def small_layout(rows: int = 2, cols: int = 2) -> WhiskerLayout:
    """A corner of the thesis's grid."""
    grid = layouts.thesis_grid()
    chosen = np.array([row * grid.cols + col for row in range(rows) for col in range(cols)])
    return replace(
        grid,
        name="small",
        rows=rows,
        cols=cols,
        p_base=grid.p_base[chosen],
        R_base_whisker=grid.R_base_whisker[chosen],
        length=grid.length[chosen],
        present=grid.present[chosen],
    )


class SimulatedHallArray:
    """Sends frames at 200 Hz in the `framed` protocol; `hold` sets what the whiskers do.

    `seen` maps the fields of all whiskers, shape (n, 3), to what the sensors send, in their order and axes.
    """

    def __init__(
        self,
        link: Path,
        layout: WhiskerLayout,
        *,
        seed: int = 4,
        seen: Callable[[np.ndarray], np.ndarray] = lambda field: field,
    ) -> None:
        self.layout, self.seen = layout, seen
        self.hall = HallArray(layout, seed)
        self.rng = np.random.default_rng(seed)
        self.valid = np.ones(layout.count, dtype=bool)
        self.hinge: Callable[[], np.ndarray] = lambda: np.zeros((layout.count, 2))
        self.master, self.slave = pty.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        link.symlink_to(os.ttyname(self.slave))
        os.set_blocking(self.master, False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def hold(self, inclination_deg, azimuth_deg, whisker: int | None = None) -> None:
        """Hold one or all whiskers at given angles (numbers or arrays); a frame that began before is not affected."""
        hinge = np.zeros((self.layout.count, 2))
        angles = np.broadcast_to(hinge_angles(*np.deg2rad([inclination_deg, azimuth_deg])), hinge.shape)
        chosen = slice(None) if whisker is None else whisker
        hinge[chosen] = angles[chosen]
        self.hinge = lambda: hinge

    def circle(self, inclination_deg: float, turns_per_s: float = 4.0) -> None:
        """Lead all whiskers round."""

        def hinge() -> np.ndarray:
            azimuth = 2 * np.pi * turns_per_s * time.monotonic() + np.zeros(self.layout.count)
            return hinge_angles(np.full(self.layout.count, np.deg2rad(inclination_deg)), azimuth)

        self.hinge = hinge

    def _run(self) -> None:
        sequence, received = 0, b""
        n, rows, cols = self.layout.count, self.layout.rows, self.layout.cols
        while not self._stop.wait(0.005):
            with contextlib.suppress(BlockingIOError):
                received += os.read(self.master, 4096)
            *packets, received = received.split(b"\0")
            for packet in packets:
                body = cobs.decode(packet)
                if body[0] == 0xF0:
                    self._send(0x71, sequence, self._now_us(), body[8:12])
            now = self._now_us()
            field = self.seen(self.hall.sample(self.hall.field(self.hinge(), np.eye(3)), self.rng))
            field = np.where(self.valid[:, None], field, 0.0)
            bitmap = np.packbits(self.valid, bitorder="little").tobytes()
            counts = np.rint(field / 0.01).astype("<i2").tobytes()
            self._send(0x01, sequence, now, struct.pack("<BBH", rows, cols, 1000 // n) + bitmap + counts)
            sequence += 1

    def _now_us(self) -> int:
        return time.monotonic_ns() // 1000

    def _send(self, kind: int, sequence: int, now_us: int, payload: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self.master, make_packet(kind, sequence, now_us, payload))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self.slave)
        os.close(self.master)


def write_configuration(folder: Path, layout: WhiskerLayout, calibration: str | None = None) -> Path:
    """A configuration for the array on the port `folder`/whiskers."""
    (folder / "small.json").write_text(layouts.to_json(layout))
    line = f'calibration = "{calibration}"\n' if calibration else ""
    path = folder / "config.toml"
    path.write_text(
        f'[robot]\nlayout = "small.json"\n[[device]]\nname = "whiskers"\nport = "{folder / "whiskers"}"\n{line}'
    )
    return path


class Program:
    """The command line as a process; events on its standard output, Enter on its standard input."""

    def __init__(self, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", "from robominer_slam.cli.main import main; main()", *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def events(self):
        """JSON objects from standard output until the program ends."""
        for line in self.process.stdout:
            yield json.loads(line)

    def enter(self, text: str = "") -> None:
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def end(self) -> tuple[int, str]:
        """Exit code and standard error."""
        self.process.stdin.close()
        error = self.process.stderr.read()
        code = self.process.wait(timeout=30)
        self.process.stdout.close()
        self.process.stderr.close()
        return code, error


def run(*arguments: object) -> tuple[int, str, str]:
    """The command line in this process, without interaction: exit code, standard output, standard error."""
    out, error, code = io.StringIO(), io.StringIO(), 0
    argv = sys.argv
    sys.argv = ["robominer-slam", *map(str, arguments)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
            main()
    except SystemExit as done:
        code = int(done.code or 0)
    finally:
        sys.argv = argv
    return code, out.getvalue(), error.getvalue()
