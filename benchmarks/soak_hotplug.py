"""Unplugs and replugs a device 200 times, half of them under another name, and looks for leaks.

Usage: python -m benchmarks.soak_hotplug [--cycles N]

The device is the simulator's IMU protocol on a pseudo-terminal; another device goes on meanwhile. Printed: time from
plug to first measurement, file descriptors, memory, measurements of the other device.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import logging
import os
import pty
import tempfile
import threading
import time
import tty
from pathlib import Path

import numpy as np

from drivers.measurement import HallFrame, ImuSample
from drivers.serial_reader import SerialReader
from drivers.settings import DeviceSettings
from sim_backend.framed_encoder import PING, CommandDecoder, FramedEncoder

PERIOD_S = 0.02
TIMEOUT_S = 5.0
#: Memory is compared from here on: the first cycles fill caches.
WARM_UP = 20


class Plugged:
    """A device on a pseudo-terminal that is there until it is pulled."""

    def __init__(self, link: Path, kind: str) -> None:
        self.link, self._kind = link, kind
        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        link.symlink_to(os.ttyname(self._slave))
        os.set_blocking(self._master, False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"device {kind}")
        self._thread.start()

    def pull(self) -> None:
        """Take it out: the port ends, its name goes."""
        self._stop.set()
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)
        self.link.unlink()

    def _run(self) -> None:
        encoder, commands = FramedEncoder(), CommandDecoder()
        while not self._stop.wait(PERIOD_S):
            # Nobody reads, nobody asks: then there is nothing to do.
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, self._sample(encoder))
                for kind, payload in commands.feed(os.read(self._master, 4096)):
                    if kind == PING:
                        os.write(self._master, encoder.pong(device_time_us(), int.from_bytes(payload, "little")))

    def _sample(self, encoder: FramedEncoder) -> bytes:
        if self._kind == "imu":
            return encoder.imu(device_time_us(), np.zeros(3), np.array([0.0, 0.0, 9.81]))
        return encoder.hall(device_time_us(), 2, 2, 600, np.ones(4, dtype=np.bool_), np.ones((4, 3)))


def device_time_us() -> int:
    """The devices' clock."""
    return time.monotonic_ns() // 1000 & 0xFFFFFFFF


def memory_kib() -> int:
    """Resident memory of this process."""
    text = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(next(line for line in text.splitlines() if line.startswith("VmRSS")).split()[1])


def open_files() -> int:
    """File descriptors of this process."""
    return len(list(Path("/proc/self/fd").iterdir()))


def wait_for(reader: SerialReader, kind: type, counts: dict[type, int]) -> float:
    """Seconds until a measurement of this kind comes."""
    begin = time.monotonic()
    while time.monotonic() - begin < TIMEOUT_S:
        item = reader.get(0.05)
        if item is None:
            continue
        counts[type(item[1])] = counts.get(type(item[1]), 0) + 1
        if isinstance(item[1], kind):
            return time.monotonic() - begin
    raise TimeoutError(f"no {kind.__name__} within {TIMEOUT_S} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", type=int, default=200)
    cycles = parser.parse_args().cycles
    logging.disable(logging.CRITICAL)
    counts: dict[type, int] = {}
    times, files, memory = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        other, device = Plugged(at / "tty_other", "whiskers"), Plugged(at / "tty0", "imu")
        settings = [DeviceSettings(name, f"{at}/tty*", carries=name) for name in ("imu", "whiskers")]
        with SerialReader(settings) as reader:
            wait_for(reader, ImuSample, counts)
            for cycle in range(cycles):
                device.pull()
                while reader.status()[0].state != "absent":
                    reader.get(0.02)
                while (left := reader.get(0.0)) is not None:
                    counts[type(left[1])] = counts.get(type(left[1]), 0) + 1
                device = Plugged(at / f"tty{cycle if cycle % 2 else 0}", "imu")
                times.append(wait_for(reader, ImuSample, counts))
                files.append(open_files())
                memory.append(memory_kib())
            frames = counts[HallFrame]
            dropped = reader.dropped
        device.pull()
        other.pull()
    warm = min(WARM_UP, cycles - 1)
    growth = [b - a for a, b in itertools.pairwise(files[warm:])]
    print(
        "| cycles | back in use: median / worst (s) | descriptors: first / last | memory: after warm-up / last (KiB) |"
    )
    print("|---|---|---|---|")
    print(
        f"| {cycles} | {np.median(times):.2f} / {max(times):.2f} | {files[0]} / {files[-1]} "
        f"| {memory[warm]} / {memory[-1]} |"
    )
    print(f"\nthe other device delivered {frames} frames meanwhile, {dropped} dropped")
    if max(times) > 2.0 or sum(growth) > 0:
        raise SystemExit("a device was not back within 2 s, or descriptors leak")


if __name__ == "__main__":
    main()
