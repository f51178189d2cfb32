"""The simulated robot's devices: each with its own port, clock and protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_backend.device_protocols import Firmware, Seen, firmware, parse_protocol
from sim_backend.events import EncoderEvent, Event, ImuEvent, OdometryEvent, WhiskerEvent
from sim_backend.fault_schedule import KINDS, SCREWS, FaultFileError, FaultSchedule
from sim_backend.line_faults import FaultyClock, FaultyLine
from sim_backend.pseudo_terminal import PseudoTerminal
from sim_backend.random_streams import stream

#: Ports in the order of their creation, and the events that each device sends.
EVENT_OF_DEVICE: dict[str, type[Event]] = {
    "whiskers": WhiskerEvent,
    "imu": ImuEvent,
    "screws": EncoderEvent,
    "odometry": OdometryEvent,
}
BAUD = 115200
#: What is written to a pseudo-terminal can be seen on its other side after this time, ns, also on a busy machine.
GREETING_NS = 100_000_000


@dataclass(frozen=True, slots=True)
class ClockSettings:
    """A device's clock: what it shows at the start of the simulation, us, and how much too fast it runs, ppm."""

    offset_us: int
    drift_ppm: float = 0.0


#: Four boards, switched on at different times, with crystals of 20 ppm; the whiskers' wraps during a drive.
DEFAULT_CLOCKS = {
    "whiskers": ClockSettings(2**32 - 60_000_000, 12.0),
    "imu": ClockSettings(17_250_000, -18.0),
    "screws": ClockSettings(1_234_567_890, 5.0),
    "odometry": ClockSettings(3_000_000_000, -7.0),
}


class SerialDevice:
    """One device on a pseudo-terminal.

    Attributes:
        name: of the device; a screw with a board of its own is `screw_front_right` and so on.
        role: key of `EVENT_OF_DEVICE`; several devices may share one.
        port: the pseudo-terminal, or the bad cable before it.
        sent: packets taken by the host.
    """

    def __init__(
        self,
        name: str,
        port: PseudoTerminal | FaultyLine,
        clock: ClockSettings | FaultyClock,
        now_ns: int,
        *,
        role: str | None = None,
        protocol: str = "framed",
    ) -> None:
        """Plug the device in; it greets.

        Args:
            name: of the device.
            port: where it is.
            clock: its clock, or the settings of one.
            now_ns: host's monotonic time.
            role: see the class; the name if absent.
            protocol: as for `parse_protocol`.

        Raises:
            ProtocolError: a device of this role does not speak it.
        """
        self.name, self.port, self.role = name, port, role or name
        self.protocol, self._variant = parse_protocol(self.role, protocol)
        self.sent = 0
        if isinstance(clock, ClockSettings):
            clock = FaultyClock(clock.offset_us, clock.drift_ppm, now_ns)
        self._clock = clock
        self._begin: tuple[int, float] | None = None
        self._ticks: NDArray[np.int64] = np.zeros(4, np.int64)
        self._ticks_at_power_up = self._ticks
        self._firmware = self._power_up(now_ns)

    @property
    def path(self) -> Path:
        """Name of the port."""
        return self.port.path

    @property
    def screw(self) -> str | None:
        """The screw whose board this is, where each has its own."""
        return self.name.removeprefix("screw_") if self.protocol == "rm3-motor" else None

    @property
    def rezeros(self) -> int:
        """REZERO commands received since power-up."""
        return self._firmware.rezeros

    def host_came(self, now_ns: int) -> bool:
        """Whether a host wants this device's data; meaningful before the first measurement.

        It has asked for the time or sent a command. A device that never listens takes it from its greeting, which
        stays in the port until somebody opens it and reads or flushes it.
        """
        taken = now_ns - self._powered_ns > GREETING_NS and self.port.unread() == 0
        return self._firmware.asked or (self._firmware.one_way and taken)

    def settings(self) -> dict[str, str | int]:
        """The device's keys in the daemon's configuration (interfaces, section 5) that follow from the protocol."""
        keys: dict[str, str | int] = {
            "name": self.name, "port": str(self.path), "protocol": self.protocol, "baud": BAUD
        }  # fmt: skip
        if self.protocol.startswith("rm3-") and self.role == "whiskers":
            keys["representation"] = self._variant
        if self.screw is not None:
            keys["screw"] = self.screw
        return keys

    def device_time_us(self, now_ns: int) -> int:
        """What the device's clock of 32 bits shows at a time of the host's monotonic clock."""
        return self._clock.microseconds(now_ns) & 0xFFFFFFFF

    def begin(self, start_ns: int, rate: float) -> None:
        """The drive begins at `start_ns` of the host's clock: the schedule of faults counts from here."""
        self._begin = start_ns, rate
        self._clock.begin(start_ns, rate)

    def advance(self, now_ns: int) -> None:
        """Let scheduled faults of the line begin and end.

        Raises:
            OSError: the port cannot be made again.
        """
        if isinstance(self.port, FaultyLine) and self._begin is not None:
            start_ns, rate = self._begin
            if self.port.advance((now_ns - start_ns) * 1e-9 * rate):
                # The USB line is its supply too: it starts afresh, with its clock and its counters at zero.
                self._clock.restart(now_ns)
                self._ticks_at_power_up = self._ticks
                self._firmware = self._power_up(now_ns)

    def answer(self, clock: Callable[[], int]) -> None:
        """Answer what the host has sent; `clock` gives the host's monotonic time in ns."""
        for packet in self._firmware.answers(self.port.read(), lambda: self._clock.microseconds(clock())):
            self.port.write(packet)

    def send(self, event: Event, measured_ns: int, rate: float, array: tuple[int, int, int]) -> None:
        """Send a measurement that began at `measured_ns` of the host's monotonic clock.

        Args:
            event: this device's measurement.
            measured_ns: host time of its beginning.
            rate: simulated seconds per second. Seen from the host, the robot then drives `rate` times as fast:
                rates and velocities grow with it, accelerations with its square, gravity stays.
            array: rows, columns and period between two sensors, us, of the whisker array.
        """
        if isinstance(event, EncoderEvent):
            self._ticks = event.ticks
            event = replace(event, ticks=event.ticks - self._ticks_at_power_up)
        packet = self._firmware.packet(event, Seen(self._clock.microseconds(measured_ns), rate, array))
        if packet:
            self.sent += self.port.write(packet)

    def _power_up(self, now_ns: int) -> Firmware:
        self._powered_ns = now_ns
        switched_on = firmware(self.name, self.protocol, self._variant, self.screw)
        greeting = switched_on.greeting(self._clock.microseconds(now_ns))
        if greeting:
            self.port.write(greeting)
        return switched_on


def plug_in(
    folder: Path,
    names: tuple[str, ...],
    now_ns: int,
    clocks: Mapping[str, ClockSettings] | None = None,
    *,
    protocols: Mapping[str, str] | None = None,
    faults: FaultSchedule | None = None,
    seed: int = 0,
) -> dict[str, SerialDevice]:
    """The devices of these names, on ports `folder`/<name>.

    With `rm3-motor` the screws are four devices, `screw_front_right` and so on.

    Args:
        folder: of the ports.
        names: keys of `EVENT_OF_DEVICE`.
        now_ns: host's monotonic time.
        clocks: where other than `DEFAULT_CLOCKS`.
        protocols: where other than `framed`, as for `parse_protocol`.
        faults: of lines and clocks, by a device's name or its role.
        seed: of the damage that bad lines do.

    Raises:
        ProtocolError: a device does not speak its protocol, or there is no such device.
        FaultFileError: a fault befalls a device that is not there.
        OSError: a port cannot be made.
    """
    chosen = DEFAULT_CLOCKS | dict(clocks or {})
    spoken = dict.fromkeys(names, "framed") | dict(protocols or {})
    boards = {role: _boards(role, parse_protocol(role, text)[0]) for role, text in spoken.items()}
    known = set(boards) | {board for several in boards.values() for board in several}
    for fault in faults.faults if faults is not None else ():
        if KINDS[fault.kind].target == "device" and fault.target not in known:
            there = ", ".join(sorted(known))
            raise FaultFileError(f"{fault.kind} at {fault.start:g} s: no device {fault.target!r}; there are {there}")
    devices: dict[str, SerialDevice] = {}
    for role in names:
        for name in boards[role]:
            bad = faults.of_device(name, role) if faults is not None else ()
            path = folder / name
            port = FaultyLine(path, bad, stream(seed, f"line {name}")) if bad else PseudoTerminal(path)
            clock = FaultyClock(chosen[role].offset_us, chosen[role].drift_ppm, now_ns, bad)
            devices[name] = SerialDevice(name, port, clock, now_ns, role=role, protocol=spoken[role])
    return devices


def _boards(role: str, protocol: str) -> list[str]:
    return [f"screw_{screw}" for screw in SCREWS] if protocol == "rm3-motor" else [role]
