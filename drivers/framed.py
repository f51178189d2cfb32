"""Decoder of the `framed` protocol: COBS packets ended by 0x00 with a CRC-32, and the host's own packets.

Packet: type u8, version u8, sequence u16, device_time u32 (us), payload, crc u32 (IEEE), little-endian.
Sans-IO: it takes bytes in any fragmentation and never raises on them; what it drops it counts by reason.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from cobs import cobs

from drivers.counters import Counters
from drivers.measurement import BoolArray, FloatArray
from drivers.readings import (
    RADIANS_PER_SECOND_PER_RPM,
    EncoderReading,
    HallReading,
    HelloReading,
    ImuReading,
    MotorReading,
    OdometryReading,
    PongReading,
    Reading,
)

VERSION = 1
HALL, IMU, ENCODERS, MOTORS, ODOMETRY, HELLO, PONG = 0x01, 0x02, 0x03, 0x04, 0x05, 0x70, 0x71
PING, REZERO, IDENTIFY = 0xF0, 0xF1, 0xF2

#: The longest packet a device may send: a 255 x 255 array never exists, 64 x 64 whiskers fit in 25 kB.
MAX_ENCODED_BYTES = 32768
SCREW_COUNT = 4
MILLITESLA_PER_LSB = 0.01

_HEADER = struct.Struct("<BBHI")
_CRC = struct.Struct("<I")
_SHORTEST = _HEADER.size + _CRC.size
#: CRC-32 of any bytes followed by their own CRC-32.
_CRC_OF_WHOLE = 0x2144DF1C
_HALL_HEAD = struct.Struct("<BBH")
_TICKS = struct.Struct(f"<{SCREW_COUNT}i")
#: Made once: numpy takes as long to read a type's name as to convert six numbers.
_INT16, _FLOAT32, _FLOAT64 = np.dtype("<i2"), np.dtype("<f4"), np.dtype(np.float64)


class PayloadError(ValueError):
    """A packet whose check holds but whose payload does not fit its type."""


class FramedDecoder:
    """Bytes of one port to readings.

    Attributes:
        counters: `packets` taken and, by reason, what was dropped: `bad_cobs`, `bad_crc`, `bad_version`,
            `bad_payload`, `too_short`, `too_long`, `unknown_type`, `not_finite`, `duplicates`; `lost` counts
            packets missing from a type's sequence.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        #: What came of the packet that is not complete.
        self._buffer = b""
        self._skipping = False
        self._last: dict[int, tuple[int, int]] = {}

    def feed(self, data: bytes) -> list[Reading]:
        """Take some bytes; return the readings that they complete."""
        readings: list[Reading] = []
        *packets, self._buffer = (self._buffer + data).split(b"\0")
        for packet in packets:
            if self._skipping:
                # The rest of a packet whose start was thrown away as too long.
                self._skipping = False
            elif packet:
                reading = self._decode(packet)
                if reading is not None:
                    readings.append(reading)
        if len(self._buffer) > MAX_ENCODED_BYTES:
            self._buffer = b""
            if not self._skipping:
                self.counters["too_long"] += 1
            self._skipping = True
        return readings

    def _decode(self, encoded: bytes) -> Reading | None:
        if len(encoded) > MAX_ENCODED_BYTES:
            self.counters["too_long"] += 1
            return None
        try:
            packet = cobs.decode(encoded)
        except cobs.DecodeError:
            self.counters["bad_cobs"] += 1
            return None
        if len(packet) < _SHORTEST:
            self.counters["too_short"] += 1
            return None
        if zlib.crc32(packet) != _CRC_OF_WHOLE:
            self.counters["bad_crc"] += 1
            return None
        kind, version, sequence, device_time = _HEADER.unpack_from(packet)
        if version != VERSION:
            self.counters["bad_version"] += 1
            return None
        parse = _PARSERS.get(kind)
        if parse is None:
            self.counters["unknown_type"] += 1
            return None
        if not self._in_sequence(kind, sequence, device_time):
            return None
        try:
            reading = parse(device_time, sequence, packet[_HEADER.size : -_CRC.size])
        except PayloadError:
            self.counters["bad_payload"] += 1
            return None
        self.counters["packets"] += 1
        return reading

    def _in_sequence(self, kind: int, sequence: int, device_time: int) -> bool:
        """Count lost packets; False for a packet that came twice."""
        last = self._last.get(kind)
        self._last[kind] = (sequence, device_time)
        if last is None:
            return True
        if last == (sequence, device_time):
            self.counters["duplicates"] += 1
            return False
        missing = (sequence - last[0] - 1) & 0xFFFF
        # A large gap is a device that started anew, not 32768 lost packets.
        if 0 < missing < 0x8000:
            self.counters["lost"] += missing
        return True


def _expect(payload: bytes, size: int) -> None:
    if len(payload) != size:
        raise PayloadError(f"payload of {len(payload)} bytes, expected {size}")


def _parse_hall(time_us: int, sequence: int, payload: bytes) -> Reading:
    if len(payload) < _HALL_HEAD.size:
        raise PayloadError("HALL without its head")
    rows, cols, period = _HALL_HEAD.unpack_from(payload)
    count = rows * cols
    at = _HALL_HEAD.size + (count + 7) // 8
    _expect(payload, at + 6 * count)
    if count == 0:
        raise PayloadError("HALL of no sensors")
    valid = _valid(payload[_HALL_HEAD.size : at], rows, cols)
    raw = np.frombuffer(payload, _INT16, 3 * count, at)
    field_mT = (raw.astype(_FLOAT64) * MILLITESLA_PER_LSB).reshape(rows, cols, 3)
    return HallReading(time_us, sequence, field_mT, valid, period)


@lru_cache(maxsize=16)
def _valid(bitmap: bytes, rows: int, cols: int) -> BoolArray:
    """Which sensors were read, shape (rows, cols); the same frame after frame, so it is kept and read-only."""
    bits = np.unpackbits(np.frombuffer(bitmap, np.uint8), count=rows * cols, bitorder="little")
    valid = bits.astype(np.bool_).reshape(rows, cols)
    valid.flags.writeable = False
    return valid


def _floats(payload: bytes, count: int, offset: int = 0) -> FloatArray:
    return np.frombuffer(payload, _FLOAT32, count, offset).astype(_FLOAT64)


def _parse_imu(time_us: int, sequence: int, payload: bytes) -> Reading:
    _expect(payload, 24)
    values = _floats(payload, 6)
    return ImuReading(time_us, sequence, values[:3], values[3:])


def _parse_encoders(time_us: int, sequence: int, payload: bytes) -> Reading:
    if not payload:
        raise PayloadError("ENCODERS without its count")
    count = payload[0]
    _expect(payload, 1 + 4 * count)
    if count != SCREW_COUNT:
        raise PayloadError(f"{count} screws, expected {SCREW_COUNT}")
    return EncoderReading(time_us, sequence, _TICKS.unpack_from(payload, 1))


def _parse_motors(time_us: int, sequence: int, payload: bytes) -> Reading:
    if not payload:
        raise PayloadError("MOTORS without its count")
    count = payload[0]
    _expect(payload, 1 + 12 * count)
    if count != SCREW_COUNT:
        raise PayloadError(f"{count} screws, expected {SCREW_COUNT}")
    values = _floats(payload, 3 * count, offset=1).reshape(count, 3)
    return MotorReading(time_us, sequence, values[:, 0] * RADIANS_PER_SECOND_PER_RPM, values[:, 1], values[:, 2])


def _parse_odometry(time_us: int, sequence: int, payload: bytes) -> Reading:
    _expect(payload, 12)
    return OdometryReading(time_us, sequence, _floats(payload, 3))


def _parse_hello(time_us: int, sequence: int, payload: bytes) -> Reading:
    return HelloReading(time_us, sequence, payload.decode("utf-8", errors="replace"))


def _parse_pong(time_us: int, sequence: int, payload: bytes) -> Reading:
    _expect(payload, 4)
    return PongReading(time_us, sequence, _CRC.unpack(payload)[0])


_PARSERS: dict[int, Callable[[int, int, bytes], Reading]] = {
    HALL: _parse_hall,
    IMU: _parse_imu,
    ENCODERS: _parse_encoders,
    MOTORS: _parse_motors,
    ODOMETRY: _parse_odometry,
    HELLO: _parse_hello,
    PONG: _parse_pong,
}


def host_packet(kind: int, sequence: int, payload: bytes = b"") -> bytes:
    """A packet from the host, encoded and ended: PING (payload: nonce u32), REZERO or IDENTIFY."""
    body = _HEADER.pack(kind, VERSION, sequence & 0xFFFF, 0) + payload
    encoded: bytes = cobs.encode(body + _CRC.pack(zlib.crc32(body)))
    return encoded + b"\0"


def ping(sequence: int, nonce: int) -> bytes:
    """A PING packet."""
    return host_packet(PING, sequence, _CRC.pack(nonce & 0xFFFFFFFF))
