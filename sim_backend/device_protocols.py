"""Which bytes a device makes of its events and of what the host sends, for every protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol, get_args

from sim_backend.bno08x_rvc_encoder import Bno08xRvcEncoder
from sim_backend.events import EncoderEvent, Event, ImuEvent, OdometryEvent, WhiskerEvent
from sim_backend.fault_schedule import SCREWS
from sim_backend.framed_encoder import IDENTIFY, PING, REZERO, CommandDecoder, FramedEncoder
from sim_backend.mip_encoder import MipDevice, PowerUp
from sim_backend.rm3_encoder import (
    MOTOR_IDS,
    REPRESENTATIONS,
    Representation,
    Rm3MotorEncoder,
    Rm3WhiskerEncoder,
)

FIRMWARE_VERSION = "1.0"


@dataclass(frozen=True, slots=True)
class Seen:
    """How a device sees its event.

    Attributes:
        time_us: of its own clock when the measurement began, not wrapped.
        rate: simulated seconds per second. Seen from the host, the robot drives `rate` times as fast: rates and
            velocities grow with it, accelerations with its square, gravity stays.
        array: rows, columns and period between two sensors, us, of the whisker array.
    """

    time_us: int
    rate: float
    array: tuple[int, int, int]


class Firmware(Protocol):
    """What runs on a device, from power-up on.

    Attributes:
        asked: whether a host has sent something that only a host which wants this device's data sends.
        one_way: whether the device never listens.
        rezeros: REZERO commands received; the array reports raw fields, so nothing follows from them.
    """

    @property
    def asked(self) -> bool:
        """See the class."""

    @property
    def one_way(self) -> bool:
        """See the class."""

    @property
    def rezeros(self) -> int:
        """See the class."""

    def greeting(self, time_us: int, /) -> bytes:
        """What it sends at power-up."""

    def packet(self, event: Event, seen: Seen, /) -> bytes:
        """What it sends for an event; empty where nothing is due."""

    def answers(self, data: bytes, time_us: Callable[[], int], /) -> list[bytes]:
        """What it sends for what the host has sent."""


class FramedFirmware:
    """Protocol `framed`, for every kind of device."""

    one_way = False

    def __init__(self, name: str) -> None:
        """Switch it on."""
        self.asked, self.rezeros, self._name = False, 0, name
        self._encoder, self._commands = FramedEncoder(), CommandDecoder()

    def greeting(self, time_us: int) -> bytes:
        """HELLO."""
        return self._encoder.hello(time_us, f"robominer-sim {self._name} {FIRMWARE_VERSION}")

    def packet(self, event: Event, seen: Seen) -> bytes:
        """The packet for any event but the truth.

        Raises:
            TypeError: the truth goes over no port.
        """
        match event:
            case WhiskerEvent():
                rows, cols, period_us = seen.array
                period_us = round(period_us / seen.rate)
                return self._encoder.hall(seen.time_us, rows, cols, period_us, event.valid, event.field_mT)
            case ImuEvent():
                force = event.gravity + seen.rate**2 * (event.acceleration - event.gravity)
                return self._encoder.imu(seen.time_us, seen.rate * event.gyro, force)
            case EncoderEvent():
                return self._encoder.encoders(seen.time_us, event.ticks)
            case OdometryEvent():
                return self._encoder.odometry(seen.time_us, seen.rate * event.velocity)
        raise TypeError(f"{type(event).__name__} goes over no port")

    def answers(self, data: bytes, time_us: Callable[[], int]) -> list[bytes]:
        """PONG to a PING, HELLO to IDENTIFY."""
        answers = []
        for kind, payload in self._commands.feed(data):
            if kind == PING and len(payload) == 4:
                self.asked = True
                answers.append(self._encoder.pong(time_us(), int.from_bytes(payload, "little")))
            elif kind == IDENTIFY:
                answers.append(self.greeting(time_us()))
            elif kind == REZERO:
                self.rezeros += 1
        return answers


class _OneWay:
    """What devices have in common that never listen."""

    one_way, asked, rezeros = True, False, 0
    #: The end of a packet: whoever opens such a port finds the device in the middle of one.
    tail = b""

    def greeting(self, _time_us: int) -> bytes:
        """The tail of a packet whose beginning nobody heard."""
        return self.tail

    def answers(self, _data: bytes, _time_us: Callable[[], int]) -> list[bytes]:
        """Nothing."""
        return []


class Rm3WhiskerFirmware(_OneWay):
    """Protocols `rm3-plaintext` and `rm3-compressed`."""

    def __init__(self, representation: Representation, *, compressed: bool) -> None:
        """Switch it on."""
        self._representation, self._compressed = representation, compressed
        self.tail = b"\r\n" if compressed else b"]}\n"
        self._encoder: Rm3WhiskerEncoder | None = None

    def packet(self, event: Event, seen: Seen) -> bytes:
        """The frame of a whisker event."""
        if not isinstance(event, WhiskerEvent):
            return b""
        if self._encoder is None:
            self._encoder = Rm3WhiskerEncoder(seen.array[0], seen.array[1], self._representation)
        encode = self._encoder.compressed if self._compressed else self._encoder.plaintext
        return encode(event.valid, event.field_mT)


class Rm3MotorFirmware(_OneWay):
    """Protocol `rm3-motor`: one screw's board."""

    tail = b"CNYS"

    def __init__(self, screw: str, *, electrical: bool) -> None:
        """Switch on the board of a screw, such as `front_right`."""
        self._column = SCREWS.index(screw)
        self._encoder = Rm3MotorEncoder(MOTOR_IDS[screw], electrical=electrical)

    def packet(self, event: Event, seen: Seen) -> bytes:
        """The screw's speed, five times a second of the host's time."""
        if not isinstance(event, EncoderEvent):
            return b""
        return self._encoder.angle(event.time_ns, float(event.angle[self._column]), seen.rate) or b""


class Bno08xRvcFirmware(_OneWay):
    """Protocol `bno08x-rvc`."""

    tail = bytes(4)

    def __init__(self) -> None:
        """Switch it on."""
        self._encoder = Bno08xRvcEncoder()

    def packet(self, event: Event, seen: Seen) -> bytes:
        """Attitude and specific force of a sample."""
        if not isinstance(event, ImuEvent):
            return b""
        force = event.gravity + seen.rate**2 * (event.acceleration - event.gravity)
        return self._encoder.sample(event.time_ns, event.gyro, event.gravity, force)


class MipFirmware:
    """Protocol `mip`."""

    one_way, rezeros = False, 0

    def __init__(self, power_up: PowerUp) -> None:
        """Switch it on."""
        self._device = MipDevice(power_up)

    @property
    def asked(self) -> bool:
        """Whether a host has sent a command."""
        return self._device.commands > 0

    def greeting(self, _time_us: int) -> bytes:
        """Nothing: the device waits for commands."""
        return b""

    def packet(self, event: Event, seen: Seen) -> bytes:
        """Sensor data, while streaming."""
        if not isinstance(event, ImuEvent):
            return b""
        force = event.gravity + seen.rate**2 * (event.acceleration - event.gravity)
        return self._device.sample(seen.time_us, seen.rate * event.gyro, force)

    def answers(self, data: bytes, _time_us: Callable[[], int]) -> list[bytes]:
        """Acknowledgements and replies."""
        return self._device.feed(data)


class ProtocolError(ValueError):
    """No such protocol for such a device; the text is one line for the user."""


#: Protocols by device, the usual one first, with the variants that may follow a colon, the usual one first.
PROTOCOLS: dict[str, dict[str, tuple[str, ...]]] = {
    "whiskers": {
        "framed": (),
        "rm3-plaintext": ("cartesian", "spherical-magnitude"),
        "rm3-compressed": ("spherical", "cartesian", "spherical-magnitude"),
    },
    "imu": {"framed": (), "bno08x-rvc": (), "mip": get_args(PowerUp)},
    "screws": {"framed": (), "rm3-motor": ("electrical", "short")},
    "odometry": {"framed": ()},
}


def parse_protocol(device: str, text: str) -> tuple[str, str]:
    """Name and variant of a protocol, such as `rm3-compressed:cartesian`; without a variant, the usual one.

    Raises:
        ProtocolError: the device does not speak it.
    """
    if device not in PROTOCOLS:
        raise ProtocolError(f"no device {device!r}; the simulated ones are {', '.join(PROTOCOLS)}")
    name, _, variant = text.partition(":")
    offered = PROTOCOLS[device]
    if name not in offered:
        raise ProtocolError(f"{device} cannot speak {name!r}; choose from {', '.join(offered)}")
    variants = offered[name]
    if variant and variant not in variants:
        raise ProtocolError(f"{name} has no variant {variant!r}; choose from {', '.join(variants) or 'none'}")
    return name, variant or (variants[0] if variants else "")


def parse_protocols(options: Iterable[str]) -> dict[str, str]:
    """Protocols by device from texts such as `whiskers=rm3-compressed:cartesian`.

    Raises:
        ProtocolError: a text is no such pair, or the device does not speak the protocol.
    """
    chosen = {}
    for option in options:
        device, equals, protocol = option.partition("=")
        if not equals:
            raise ProtocolError(f"{option!r}: expected DEVICE=PROTOCOL, such as whiskers=rm3-compressed")
        parse_protocol(device, protocol)
        chosen[device] = protocol
    return chosen


def firmware(name: str, protocol: str, variant: str, screw: str | None = None) -> Firmware:
    """A device just switched on; `protocol` and `variant` as `parse_protocol` gives them."""
    match protocol:
        case "rm3-plaintext" | "rm3-compressed":
            representation = next(known for known in REPRESENTATIONS if known == variant)
            return Rm3WhiskerFirmware(representation, compressed=protocol == "rm3-compressed")
        case "rm3-motor":
            assert screw is not None
            return Rm3MotorFirmware(screw, electrical=variant == "electrical")
        case "bno08x-rvc":
            return Bno08xRvcFirmware()
        case "mip":
            power_up: PowerUp = next(known for known in get_args(PowerUp) if known == variant)
            return MipFirmware(power_up)
    return FramedFirmware(name)
