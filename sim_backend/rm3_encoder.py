"""The RM3 boards' side of their line formats: whisker frames as text or packed, and one screw's motor messages.

Written from the interface description alone (sections 1.2 and 1.3).
"""

from __future__ import annotations

import struct
from functools import reduce
from operator import xor
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: What the firmware sends for each sensor; the last has the magnitude as its third value.
Representation: TypeAlias = Literal["cartesian", "spherical", "spherical-magnitude"]
REPRESENTATIONS: tuple[Representation, ...] = get_args(Representation)
#: Speeds of a screw are reported this often, Hz.
MOTOR_RATE = 5.0
MOTOR_HEADER, MOTOR_TRAILER = b"SYNC", b"CNYS"
#: Identifiers that the screws' boards carry.
MOTOR_IDS = {"front_right": 0, "rear_right": 1, "rear_left": 2, "front_left": 3}
FRAME_END = b"\r\n"


def folded(field_mT: FloatArray) -> FloatArray:
    """The firmware's fold: all three components change sign where Bz is negative; shape (n, 3), mT."""
    return np.where(field_mT[:, 2:] < 0.0, -field_mT, field_mT)


def spherical(field_mT: FloatArray) -> FloatArray:
    """Azimuth atan2(By, Bx) and polar atan2(Bz, hypot(Bx, By)), degrees, and magnitude, mT; shape (n, 3) both ways."""
    x, y, z = field_mT.T
    in_plane = np.hypot(x, y)
    azimuth, polar = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, in_plane))
    return np.column_stack([azimuth, polar, np.hypot(in_plane, z)])


class Rm3WhiskerEncoder:
    """Prints one array's frames as the firmware does.

    The firmware has no word for an error: a sensor that never answered is all zeros, one that stops answering
    repeats its last value.
    """

    def __init__(self, rows: int, cols: int, representation: Representation) -> None:
        """Switch the board on: no sensor has been read."""
        self._rows, self._cols, self._representation = rows, cols, representation
        self._last = np.zeros((rows * cols, 3))

    def plaintext(self, valid: BoolArray, field_mT: FloatArray) -> bytes:
        """One line: `{`, `[x;y;z]` for each sensor, `}` for each row of the multiplexer.

        Args:
            valid: which sensors answered, shape (rows * cols,).
            field_mT: readings, shape (rows * cols, 3), mT, row-major; ignored where not valid.
        """
        values = self._values(valid, field_mT).reshape(self._rows, self._cols, -1)
        rows = (
            "{" + "".join("[" + ";".join(f"{value:.2f}" for value in sensor) + "]" for sensor in row) + "}"
            for row in values
        )
        return ("".join(rows) + "\n").encode("ascii")

    def compressed(self, valid: BoolArray, field_mT: FloatArray) -> bytes:
        """Values times 100, truncated toward zero, as i16 little-endian, then CR LF; arguments as of `plaintext`."""
        hundredths = np.trunc(self._values(valid, field_mT).astype(np.float32) * np.float32(100.0))
        packed: bytes = np.clip(hundredths, -32768, 32767).astype("<i2").tobytes()
        return packed + FRAME_END

    def _values(self, valid: BoolArray, field_mT: FloatArray) -> FloatArray:
        self._last = np.where(valid[:, None], folded(field_mT), self._last)
        if self._representation == "cartesian":
            return self._last
        angles = spherical(self._last)
        return angles if self._representation == "spherical-magnitude" else angles[:, :2]


def motor_message(motor_id: int, rpm: float, electrical: tuple[float, float] | None = None) -> bytes:
    """One screw's message.

    Args:
        motor_id: 0 FR, 1 RR, 2 RL, 3 FL.
        rpm: speed of the screw.
        electrical: current in mA and voltage in V, or None for the short form.

    Returns:
        `SYNC`, 7 or 15 bytes of which the last is their XOR, `CNYS`.
    """
    floats = struct.pack("<f", rpm) if electrical is None else struct.pack("<3f", rpm, *electrical)
    body = struct.pack("<bb", motor_id, len(floats)) + floats
    return MOTOR_HEADER + body + bytes([reduce(xor, body)]) + MOTOR_TRAILER


class Rm3MotorEncoder:
    """One screw's board: it differentiates the screw's angle and reports its speed five times a second.

    A screw draws an idle current and more with its speed, from a battery of 24 V that sags: figures of no
    particular motor, for nothing in this project uses them but to pass them on.
    """

    IDLE_MA, MA_PER_RPM = 350.0, 12.0
    BATTERY_V, OHM = 24.0, 0.4

    def __init__(self, motor_id: int, *, electrical: bool) -> None:
        """Switch the board on; `electrical` chooses the long form, with current and voltage."""
        self._motor_id, self._electrical = motor_id, electrical
        self._before: tuple[int, float] | None = None

    def angle(self, time_ns: int, angle: float, rate: float = 1.0) -> bytes | None:
        """A message when one is due.

        Args:
            time_ns: simulated time of the angle.
            angle: of the screw, rad, cumulative.
            rate: simulated seconds per second: how much faster the screw seems to turn.
        """
        if self._before is None:
            self._before = time_ns, angle
            return None
        elapsed = (time_ns - self._before[0]) * 1e-9 / rate
        # Sampling instants are rounded to nanoseconds.
        if elapsed < 1.0 / MOTOR_RATE - 1e-6:
            return None
        rpm = (angle - self._before[1]) / elapsed * 60.0 / (2.0 * np.pi)
        self._before = time_ns, angle
        if not self._electrical:
            return motor_message(self._motor_id, rpm)
        current = self.IDLE_MA + self.MA_PER_RPM * abs(rpm)
        return motor_message(self._motor_id, rpm, (current, self.BATTERY_V - self.OHM * current / 1000.0))
