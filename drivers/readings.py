"""What a decoder yields: contents in SI units, still in the device's own time.

The clock (`clock.py`) and the device (`device.py`) turn readings into measurements with host time. They are tuples:
two hundred are made each second, and to fill a frozen dataclass takes twice as long.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np

from drivers.counters import Counters
from drivers.measurement import BoolArray, FloatArray

RADIANS_PER_SECOND_PER_RPM = 2.0 * np.pi / 60.0


class HallReading(NamedTuple):
    """Field of the whole array, shape (rows, cols, 3), with validity and the time between sensors.

    `representation` as of `measurement.HallFrame`; a sensor period of 0 says that the device does not tell.
    """

    device_time_us: int | None
    sequence: int | None
    field_mT: FloatArray
    valid: BoolArray
    sensor_period_us: int
    representation: str = "Cartesian"


class ImuReading(NamedTuple):
    """Angular rate (rad/s) and specific force (m/s2), shape (3,) each; orientation where the device has it."""

    device_time_us: int | None
    sequence: int | None
    gyro: FloatArray | None
    acceleration: FloatArray | None
    orientation_xyzw: FloatArray | None = None


class EncoderReading(NamedTuple):
    """Cumulative ticks of the screws as sent: they wrap modulo 2^32."""

    device_time_us: int | None
    sequence: int | None
    ticks: tuple[int, ...]


class MotorReading(NamedTuple):
    """Speeds (rad/s), currents (mA) and voltages (V) of the screws, shape (4,), NaN where nothing is said."""

    device_time_us: int | None
    sequence: int | None
    speed: FloatArray
    current_mA: FloatArray
    voltage_V: FloatArray


class ScrewReading(NamedTuple):
    """Speed (rad/s) of one screw (0 FR, 1 RR, 2 RL, 3 FL), current (mA) and voltage (V) where they are sent."""

    device_time_us: int | None
    sequence: int | None
    screw: int
    speed: float
    current_mA: float | None
    voltage_V: float | None


class OdometryReading(NamedTuple):
    """Body velocity vx, vy (m/s), wz (rad/s), shape (3,), mean over the interval that ends at the time."""

    device_time_us: int | None
    sequence: int | None
    velocity: FloatArray


class HelloReading(NamedTuple):
    """The firmware's name and version."""

    device_time_us: int | None
    sequence: int | None
    text: str


class PongReading(NamedTuple):
    """The answer to a PING; the device time is the device's clock when it answered."""

    device_time_us: int
    sequence: int | None
    nonce: int


Reading: TypeAlias = (
    HallReading
    | ImuReading
    | EncoderReading
    | MotorReading
    | ScrewReading
    | OdometryReading
    | HelloReading
    | PongReading
)


class Decoder(Protocol):
    """Sans-IO: bytes in any fragmentation in, readings out; never raises on what comes from the line."""

    counters: Counters

    def feed(self, data: bytes) -> list[Reading]:
        """Take some bytes; return the readings that they complete."""
        ...


def count_not_finite(reading: Reading) -> int:
    """How many values of a reading are not finite numbers; such a reading is never used.

    A decoder of whisker frames makes such sensors invalid itself: the rest of the frame is good.
    """
    parts: tuple[FloatArray | float | None, ...]
    match reading:
        case ImuReading():
            parts = (reading.gyro, reading.acceleration, reading.orientation_xyzw)
        case OdometryReading():
            parts = (reading.velocity,)
        case MotorReading() | ScrewReading():
            parts = (reading.speed, reading.current_mA, reading.voltage_V)
        case _:
            return 0
    # As floats: numpy takes longer to begin with three numbers than to look at them one by one.
    values: list[float] = []
    for part in parts:
        if isinstance(part, float):
            values.append(part)
        elif part is not None:
            values += part.tolist()
    # A sum is finite only if all its terms are.
    return 0 if math.isfinite(sum(values)) else sum(not math.isfinite(value) for value in values)
