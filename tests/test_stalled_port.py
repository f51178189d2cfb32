"""A line that stalls for 600 ms and then delivers everything at once: stamps stay right (field notes, serial ports)."""

from __future__ import annotations

import contextlib
import os
import pty
import threading
import time
import tty
from pathlib import Path

import numpy as np

from drivers.measurement import ImuSample
from drivers.serial_reader import SerialReader
from drivers.settings import DeviceSettings
from sim_backend.framed_encoder import PING, CommandDecoder, FramedEncoder

STALL_S, EVERY_S = 0.6, 2.0


class StallingDevice:
    """An IMU behind a line that holds everything back, answers included, for 0.6 s every 2 s; clock 100 ppm fast."""

    def __init__(self, link: Path) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        link.symlink_to(os.ttyname(self._slave))
        os.set_blocking(self._master, False)
        self.true_ns: list[int] = []
        self.held: list[bool] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)

    def _clock_us(self, now_ns: int) -> int:
        # Near its end, so that it wraps within the test.
        return (0xFFFFFFFF - 3_000_000 + int(now_ns * 1.0001) // 1000 - self._start_us) & 0xFFFFFFFF

    def _run(self) -> None:
        encoder, commands, waiting = FramedEncoder(), CommandDecoder(), b""
        begin = time.monotonic()
        self._start_us = int(time.monotonic_ns() * 1.0001) // 1000
        while not self._stop.wait(0.01):
            stalled = (time.monotonic() - begin) % EVERY_S > EVERY_S - STALL_S
            with contextlib.suppress(BlockingIOError):
                for kind, payload in commands.feed(os.read(self._master, 4096)):
                    if kind == PING:
                        waiting += encoder.pong(self._clock_us(time.monotonic_ns()), int.from_bytes(payload, "little"))
            now_ns = time.monotonic_ns()  # read once: the machine may suspend this thread between two readings
            self.true_ns.append(now_ns)
            self.held.append(stalled)
            index = float(len(self.true_ns) - 1)
            waiting += encoder.imu(self._clock_us(now_ns), [index, 0.0, 0.0], [0.0, 0.0, 9.81])
            if not stalled:
                with contextlib.suppress(BlockingIOError):
                    waiting = waiting[os.write(self._master, waiting) :]


def test_stamps_are_right_within_2_ms_after_a_stall_and_its_burst(tmp_path):
    device = StallingDevice(tmp_path / "imu")
    errors, stated, held = [], [], []
    try:
        with SerialReader([DeviceSettings("imu", str(tmp_path / "imu"))]) as reader:
            end = time.monotonic() + 7.0
            while time.monotonic() < end:
                item = reader.get(0.1)
                if item is not None and isinstance(item[1], ImuSample) and item[1].gyro is not None:
                    index = round(float(item[1].gyro[0]))
                    errors.append(item[1].stamp_ns - device.true_ns[index])
                    stated.append(reader.status()[0].clock_uncertainty_ns)
                    held.append(device.held[index])
            status = reader.status()[0]
    finally:
        device.close()
    error_ms = np.abs(np.array(errors)) * 1e-6
    assert len(errors) > 400
    assert sum(held) > 100
    # Where the machine is too busy for a quick ping the stamps cannot be better than the bound that the port states.
    bound_ms = np.maximum(2.0, np.array(stated) * 1e-6)
    assert np.mean(error_ms < bound_ms) >= 0.98
    assert np.mean((error_ms < bound_ms)[np.array(held)]) >= 0.98
    assert np.median(error_ms) < 2.0
    assert 0 < status.clock_uncertainty_ns < 20_000_000
    assert status.state == "streaming"
