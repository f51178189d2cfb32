"""The simulated robot's devices: each with its own port, clock and packets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sim_backend.events import EncoderEvent, Event, ImuEvent, OdometryEvent, TruthEvent, WhiskerEvent
from sim_backend.framed_encoder import IDENTIFY, PING, CommandDecoder, FramedEncoder
from sim_backend.pseudo_terminal import PseudoTerminal

FIRMWARE_VERSION = "1.0"
#: Ports in the order of their creation, and the events that each device sends.
EVENT_OF_DEVICE: dict[str, type[Event]] = {
    "whiskers": WhiskerEvent,
    "imu": ImuEvent,
    "screws": EncoderEvent,
    "odometry": OdometryEvent,
}


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
        name: of the device.
        pinged: whether a host has asked for the time.
        rezeros: REZERO commands received; the array reports raw fields, so nothing follows from them.
        sent: packets taken by the host.
    """

    def __init__(self, name: str, port: PseudoTerminal, clock: ClockSettings, now_ns: int) -> None:
        """Plug the device in; it says HELLO."""
        self.name, self.port = name, port
        self.pinged = False
        self.rezeros = 0
        self.sent = 0
        self._clock, self._plugged_ns = clock, now_ns
        self._encoder = FramedEncoder()
        self._commands = CommandDecoder()
        self._hello(now_ns)

    @property
    def path(self) -> Path:
        """Name of the port."""
        return self.port.path

    def device_time_us(self, now_ns: int) -> int:
        """What the device's clock shows at a time of the host's monotonic clock."""
        elapsed_us = (now_ns - self._plugged_ns) * (1.0 + 1e-6 * self._clock.drift_ppm) / 1000.0
        return (self._clock.offset_us + round(elapsed_us)) & 0xFFFFFFFF

    def answer(self, clock: Callable[[], int]) -> None:
        """Answer what the host has sent; `clock` gives the host's monotonic time in ns."""
        for kind, payload in self._commands.feed(self.port.read()):
            if kind == PING and len(payload) == 4:
                self.pinged = True
                nonce = int.from_bytes(payload, "little")
                self.port.write(self._encoder.pong(self.device_time_us(clock()), nonce))
            elif kind == IDENTIFY:
                self._hello(clock())
            else:
                self.rezeros += 1

    def send(self, event: Event, measured_ns: int, rate: float, array: tuple[int, int, int]) -> None:
        """Send a measurement that began at `measured_ns` of the host's monotonic clock.

        Args:
            event: this device's measurement.
            measured_ns: host time of its beginning.
            rate: simulated seconds per second. Seen from the host, the robot then drives `rate` times as fast:
                rates and velocities grow with it, accelerations with its square, gravity stays.
            array: rows, columns and period between two sensors, us, of the whisker array.
        """
        time_us = self.device_time_us(measured_ns)
        match event:
            case WhiskerEvent():
                rows, cols, period_us = array
                packet = self._encoder.hall(time_us, rows, cols, round(period_us / rate), event.valid, event.field_mT)
            case ImuEvent():
                force = event.gravity + rate**2 * (event.acceleration - event.gravity)
                packet = self._encoder.imu(time_us, rate * event.gyro, force)
            case EncoderEvent():
                packet = self._encoder.encoders(time_us, event.ticks)
            case OdometryEvent():
                packet = self._encoder.odometry(time_us, rate * event.velocity)
            case TruthEvent():
                raise TypeError("the truth goes over no port")
        self.sent += self.port.write(packet)

    def _hello(self, now_ns: int) -> None:
        text = f"robominer-sim {self.name} {FIRMWARE_VERSION}"
        self.port.write(self._encoder.hello(self.device_time_us(now_ns), text))


def plug_in(
    folder: Path, names: tuple[str, ...], now_ns: int, clocks: dict[str, ClockSettings] | None = None
) -> dict[str, SerialDevice]:
    """The devices of these names, on ports `folder`/<name>.

    Raises:
        OSError: a port cannot be made.
    """
    chosen = DEFAULT_CLOCKS | (clocks or {})
    return {name: SerialDevice(name, PseudoTerminal(folder / name), chosen[name], now_ns) for name in names}
