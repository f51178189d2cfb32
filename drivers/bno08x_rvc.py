"""Decoder of `bno08x-rvc`: a BNO080/085 in UART-RVC mode (BNO08X data sheet, section 1.3.5.2).

19 bytes: AA AA, index u8, yaw, pitch, roll (i16, 0.01 deg), ax, ay, az (i16, mg), 3 reserved bytes, and the sum of the
bytes from index to reserved; little-endian. The attitude is yaw, then pitch, then roll; there is no gyro. Sans-IO.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from drivers.counters import Counters
from drivers.measurement import FloatArray
from drivers.readings import ImuReading, Reading

HEADER = b"\xaa\xaa"
SIZE = 19
METRES_PER_SECOND2_PER_MILLI_G = 9.80665e-3
#: Half of 0.01 deg, in radians: the half angles of a quaternion.
_HALF_STEP = math.radians(0.01) / 2.0
_BODY = struct.Struct("<B6h")
_LIMITS = (18000, 9000, 18000)
INDEX_MODULUS = 256


class Bno08xRvcDecoder:
    """Bytes of one port to attitude and specific force.

    Attributes:
        counters: `packets` taken; dropped: `bad_check`, `out_of_range` (after damage, where one check byte is little:
            angles beyond the sensor's); `lost` packets by their index; `dropped_bytes` outside packets.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._buffer = bytearray()
        self._in_step = True
        self._index: int | None = None

    def feed(self, data: bytes) -> list[Reading]:
        """Take some bytes; return the readings that they complete."""
        readings: list[Reading] = []
        buffer = self._buffer
        buffer += data
        at = 0
        while True:
            start = buffer.find(HEADER, at)
            if start < 0:
                keep = len(buffer) - 1 if len(buffer) > at and buffer[-1] == HEADER[0] else len(buffer)
                self._drop(keep - at)
                at = keep
                break
            self._drop(start - at)
            at = start
            if len(buffer) - at < SIZE:
                break
            packet = bytes(buffer[at : at + SIZE])
            if sum(packet[2:-1]) & 0xFF != packet[-1]:
                self.counters["bad_check"] += 1
            else:
                index, *values = _BODY.unpack_from(packet, 2)
                within = all(abs(value) <= limit for value, limit in zip(values[:3], _LIMITS, strict=True))
                if self._in_step or within:
                    readings.append(self._read(index, values))
                    at += SIZE
                    continue
                self.counters["out_of_range"] += 1
            self._drop(1)
            at += 1
        del buffer[:at]
        return readings

    def _drop(self, count: int) -> None:
        if count:
            self.counters["dropped_bytes"] += count
            self._in_step = False

    def _read(self, index: int, values: list[int]) -> ImuReading:
        self.counters["packets"] += 1
        self._in_step = True
        if self._index is not None:
            missing = (index - self._index - 1) % INDEX_MODULUS
            # A large gap is a sensor that started anew, or the same packet again.
            if missing < INDEX_MODULUS // 2:
                self.counters["lost"] += missing
        self._index = index
        acceleration = np.array(values[3:], dtype=np.float64) * METRES_PER_SECOND2_PER_MILLI_G
        return ImuReading(None, index, None, acceleration, quaternion(values[0], values[1], values[2]))


def quaternion(yaw: int, pitch: int, roll: int) -> FloatArray:
    """Quaternion x y z w of yaw, then pitch, then roll, each in 0.01 deg."""
    cy, sy = math.cos(yaw * _HALF_STEP), math.sin(yaw * _HALF_STEP)
    cp, sp = math.cos(pitch * _HALF_STEP), math.sin(pitch * _HALF_STEP)
    cr, sr = math.cos(roll * _HALF_STEP), math.sin(roll * _HALF_STEP)
    return np.array(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )
