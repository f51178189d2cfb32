"""Bad cables and bad clocks: bytes lost, flipped and doubled, stalls, unplugged devices, clocks that drift and jump.

Everything here stands between a device and its pseudo-terminal; the device itself goes on as if nothing happened.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from sim_backend.fault_schedule import Fault
from sim_backend.pseudo_terminal import PseudoTerminal

#: What a link holds back at most while it stalls, bytes; more is lost, as in a real one.
STALL_BUFFER = 1 << 20
_DAMAGE = ("bytes_lost", "bytes_flipped", "bytes_duplicated")


def damaged(data: bytes, rng: np.random.Generator, *, lost: float, flipped: float, duplicated: float) -> bytes:
    """Bytes after a bad line: each is lost, has one bit flipped, or comes twice, with these probabilities each."""
    values = np.frombuffer(data, np.uint8).copy()
    flips = rng.random(len(values)) < flipped
    values[flips] ^= (1 << rng.integers(0, 8, int(flips.sum()))).astype(np.uint8)
    times = (rng.random(len(values)) >= lost).astype(int)
    times += times * (rng.random(len(values)) < duplicated)
    spoiled: bytes = np.repeat(values, times).tobytes()
    return spoiled


class FaultyLine:
    """A pseudo-terminal behind a bad cable; the same calls as a `PseudoTerminal`.

    Until `advance` is called for the first time the line is good. A stall holds back what the device sends, not
    what the host sends, so that answers to a PING in it come late with an early time.

    Attributes:
        dropped: packets that nobody took, and those sent while the device was unplugged or the link was full.
        damaged: packets that did not pass unharmed.
        unplugged: how often the device has been unplugged.
    """

    def __init__(
        self,
        path: Path,
        faults: Iterable[Fault],
        rng: np.random.Generator,
        open_port: Callable[[Path], PseudoTerminal] = PseudoTerminal,
    ) -> None:
        """Plug the device in.

        Args:
            path: name of the port.
            faults: of this line; those of other kinds are ignored.
            rng: for the damage.
            open_port: makes a port.

        Raises:
            OSError: the port cannot be made.
        """
        faults = tuple(faults)
        self._damage = [fault for fault in faults if fault.kind in _DAMAGE]
        self._stalls = [fault for fault in faults if fault.kind == "stall"]
        self._unplugged = [fault for fault in faults if fault.kind == "unplugged"]
        self._rng, self._open_port = rng, open_port
        self._port: PseudoTerminal | None = open_port(path)
        self._path = path
        self._held: list[bytes] = []
        self._held_bytes = 0
        self._gone_ports_dropped = 0
        self._lost_packets = 0
        self._time = -1.0
        self.damaged = 0
        self.unplugged = 0

    @property
    def path(self) -> Path:
        """Name under which the device is, was, or will be there."""
        return self._path

    @property
    def plugged(self) -> bool:
        """Whether the port exists."""
        return self._port is not None

    @property
    def dropped(self) -> int:
        """See the class."""
        here = self._port.dropped if self._port is not None else 0
        return self._gone_ports_dropped + self._lost_packets + here

    def advance(self, time: float) -> bool:
        """Let the simulated time be `time` s: unplug, plug in, release what a stall held.

        Returns:
            Whether the device has just been plugged in again, and so was switched on.

        Raises:
            OSError: the port cannot be made again.
        """
        self._time = time
        current = next((fault for fault in self._unplugged if fault.active(time)), None)
        if current is not None:
            if self._port is not None:
                self._unplug()
                # The name under which it comes back is settled when it goes.
                self._path = self._path.with_name(current.text("name") or self._path.name)
            return False
        if self._port is None:
            self._port = self._open_port(self._path)
            return True
        if self._held and not self._stalled():
            held, self._held, self._held_bytes = self._held, [], 0
            if not self._port.write(b"".join(held)):
                self._lost_packets += len(held) - 1  # the port has counted one
        return False

    def fileno(self) -> int:
        """For `select`, while plugged in."""
        assert self._port is not None
        return self._port.fileno()

    def write(self, packet: bytes) -> bool:
        """Send a packet through the bad cable; False where it is dropped whole."""
        if self._port is None:
            self._lost_packets += 1
            return False
        spoiled = self._spoiled(packet)
        self.damaged += spoiled != packet
        if not spoiled:
            return True
        if self._stalled() or self._held:
            if self._held_bytes + len(spoiled) > STALL_BUFFER:
                self._lost_packets += 1
                return False
            self._held.append(spoiled)
            self._held_bytes += len(spoiled)
            return True
        return self._port.write(spoiled)

    def read(self) -> bytes:
        """What the host has sent; empty if nothing."""
        return b"" if self._port is None else self._port.read()

    def unread(self) -> int:
        """Bytes that the host has not read yet, those in a stall included."""
        return self._held_bytes + (0 if self._port is None else self._port.unread())

    def close(self) -> None:
        """Unplug for good."""
        if self._port is not None:
            self._unplug()

    def _unplug(self) -> None:
        assert self._port is not None
        self._gone_ports_dropped += self._port.dropped
        self._lost_packets += len(self._held)
        self._held, self._held_bytes = [], 0
        self._port.close()
        self._port = None
        self.unplugged += 1

    def _stalled(self) -> bool:
        return any(fault.active(self._time) for fault in self._stalls)

    def _spoiled(self, packet: bytes) -> bytes:
        active = [fault for fault in self._damage if fault.active(self._time)]
        if not active:
            return packet
        lost, flipped, duplicated = (sum(f.number("rate") for f in active if f.kind == kind) for kind in _DAMAGE)
        return damaged(packet, self._rng, lost=lost, flipped=flipped, duplicated=duplicated)


class FaultyClock:
    """What a device's clock shows, in microseconds: its own offset and drift, and what goes wrong with it."""

    WRAP = 1 << 32

    def __init__(self, offset_us: int, drift_ppm: float, now_ns: int, faults: Iterable[Fault] = ()) -> None:
        """Switch the clock on at `now_ns` of the host's monotonic clock, showing `offset_us`.

        Of the faults, drifts and jumps count from `begin`. A `clock_wrap` replaces the offset: the clock wraps
        `start` s (of the host's time) after it was switched on for the first time.
        """
        faults = tuple(faults)
        self._drifts = [fault for fault in faults if fault.kind == "clock_drift"]
        self._jumps = [fault for fault in faults if fault.kind == "clock_jump"]
        wrap = next((fault for fault in faults if fault.kind == "clock_wrap"), None)
        self._offset_us = offset_us if wrap is None else self.WRAP - round(1e6 * wrap.start)
        self._drift_ppm, self._on_ns = drift_ppm, now_ns
        self._begin: tuple[int, float] | None = None

    def begin(self, start_ns: int, rate: float) -> None:
        """The drive begins at `start_ns` of the host's clock with `rate` simulated seconds per second."""
        self._begin = start_ns, rate

    def restart(self, now_ns: int) -> None:
        """The device was switched off and on: its clock begins at zero."""
        self._offset_us, self._on_ns = 0, now_ns

    def microseconds(self, now_ns: int) -> int:
        """What it shows at a time of the host's clock, not wrapped."""
        elapsed_us = (now_ns - self._on_ns) * (1.0 + 1e-6 * self._drift_ppm) / 1000.0
        return self._offset_us + round(elapsed_us + self._fault_us(now_ns))

    def _fault_us(self, now_ns: int) -> float:
        if self._begin is None:
            return 0.0
        start_ns, rate = self._begin
        now, on = ((ns - start_ns) * 1e-9 * rate for ns in (now_ns, self._on_ns))
        fault_us = 0.0
        for fault in self._drifts:
            # Simulated seconds in which the crystal is off, since the clock was switched on.
            within = max(0.0, min(now, fault.end) - max(on, fault.start))
            fault_us += within / rate * fault.number("ppm")
        for fault in self._jumps:
            if on <= fault.start <= now:
                fault_us += 1e6 * fault.number("seconds")
        return fault_us
