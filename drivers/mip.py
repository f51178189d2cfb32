"""Decoder of `mip`, the packets of MicroStrain's inertial sensors (3DM-CV7), and the commands that start them.

`75 65`, descriptor set, payload length, fields, Fletcher checksum over all before it. Field: length with its two
header bytes, descriptor, data; big-endian. Sensor data (set 0x80): 0x04 scaled acceleration (g), 0x05 scaled gyro
(rad/s); shared: 0xD3 GPS time (f64 time of week in s, u16 week, u16 flags; without a pulse per second it runs from
power-up and its flags are clear), 0xD5 reference time (u64, ns since power-up, never set, so the better clock here).
Source: MicroStrain's MIP documentation of the CV7 and the definitions in its MIP SDK. Sans-IO.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from drivers.counters import Counters
from drivers.measurement import FloatArray
from drivers.readings import ImuReading, Reading

SYNC = b"\x75\x65"
HEADER_SIZE, CHECK_SIZE = 4, 2
SENSOR_DATA, BASE_COMMANDS, COMMANDS_3DM = 0x80, 0x01, 0x0C
ACCELERATION, GYRO, GPS_TIME, REFERENCE_TIME = 0x04, 0x05, 0xD3, 0xD5
RESUME, MESSAGE_FORMAT, DATA_STREAM, ACK = 0x06, 0x0F, 0x11, 0xF1
WRITE, ENABLE = 1, 1
STANDARD_GRAVITY = 9.80665
#: The CV7's sensors run at 1000 Hz; every tenth sample is as many as the filter can use.
DECIMATION = 10
#: What to ask for, the best first: a device that does not know a time stamp refuses the whole format.
FORMATS = ((REFERENCE_TIME, ACCELERATION, GYRO), (GPS_TIME, ACCELERATION, GYRO), (ACCELERATION, GYRO))
_GPS = struct.Struct(">dHH")
_NANOSECONDS = struct.Struct(">Q")


class MipDecoder:
    """Bytes of one port to IMU samples in the device's own axes.

    Attributes:
        counters: `packets` taken; dropped: `bad_check`, `bad_payload` (fields that do not fit); `other_packets` of no
            use here; `refused` commands; `dropped_bytes` outside packets.
        refused: commands that the device has refused, by descriptor; whoever has seen them clears it.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self.refused: set[int] = set()
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Reading]:
        """Take some bytes; return the readings that they complete."""
        readings: list[Reading] = []
        buffer = self._buffer
        buffer += data
        at = 0
        while True:
            start = buffer.find(SYNC, at)
            if start < 0:
                keep = len(buffer) - 1 if len(buffer) > at and buffer[-1] == SYNC[0] else len(buffer)
                self._drop(keep - at)
                at = keep
                break
            self._drop(start - at)
            at = start
            if len(buffer) - at < HEADER_SIZE:
                break
            end = at + HEADER_SIZE + buffer[at + 3]
            if len(buffer) < end + CHECK_SIZE:
                break
            packet = bytes(buffer[at:end])
            if fletcher(packet) == buffer[end : end + CHECK_SIZE]:
                at = end + CHECK_SIZE
                reading = self._read(packet[2], packet[HEADER_SIZE:])
                if reading is not None:
                    readings.append(reading)
            else:
                self.counters["bad_check"] += 1
                self._drop(1)
                at += 1
        del buffer[:at]
        return readings

    def _drop(self, count: int) -> None:
        if count:
            self.counters["dropped_bytes"] += count

    def _read(self, descriptor_set: int, payload: bytes) -> Reading | None:
        fields: dict[int, bytes] = {}
        at = 0
        while at < len(payload):
            size = payload[at]
            if size < 2 or at + size > len(payload):
                self.counters["bad_payload"] += 1
                return None
            descriptor, content = payload[at + 1], payload[at + 2 : at + size]
            if descriptor == ACK and descriptor_set in (BASE_COMMANDS, COMMANDS_3DM):
                self._acknowledged(content)
            fields.setdefault(descriptor, content)
            at += size
        if descriptor_set != SENSOR_DATA or not (ACCELERATION in fields or GYRO in fields):
            self.counters["other_packets"] += 1
            return None
        try:
            time_us = _time_us(fields)
            acceleration, gyro = _vector(fields.get(ACCELERATION)), _vector(fields.get(GYRO))
        except struct.error:
            self.counters["bad_payload"] += 1
            return None
        self.counters["packets"] += 1
        if acceleration is not None:
            acceleration = acceleration * STANDARD_GRAVITY
        return ImuReading(time_us, None, gyro, acceleration)

    def _acknowledged(self, content: bytes) -> None:
        if len(content) == 2 and content[1] != 0:
            self.counters["refused"] += 1
            self.refused.add(content[0])


def _time_us(fields: dict[int, bytes]) -> int | None:
    if REFERENCE_TIME in fields:
        nanoseconds: int = _NANOSECONDS.unpack(fields[REFERENCE_TIME])[0]
        return nanoseconds // 1000
    if GPS_TIME in fields:
        seconds = _GPS.unpack(fields[GPS_TIME])[0]
        # A time of week has at most 604800 s; NaN fails the comparison too.
        return round(seconds * 1e6) if 0.0 <= seconds <= 1e9 else None
    return None


def _vector(content: bytes | None) -> FloatArray | None:
    if content is None:
        return None
    return np.array(struct.unpack(">3f", content), dtype=np.float64)


def fletcher(data: bytes) -> bytes:
    """The two check bytes over everything before them: the sum, and the sum of the running sums, modulo 256."""
    first = second = 0
    for byte in data:
        first += byte
        second += first
    return bytes((first & 0xFF, second & 0xFF))


def command(descriptor_set: int, descriptor: int, data: bytes = b"") -> bytes:
    """A packet with one command."""
    field = bytes((len(data) + 2, descriptor)) + data
    packet = SYNC + bytes((descriptor_set, len(field))) + field
    return packet + fletcher(packet)


def start_streaming(wanted: Sequence[int], decimation: int = DECIMATION) -> bytes:
    """The commands that make a device send these fields, whatever it did before: format, stream on, resume."""
    entries = b"".join(struct.pack(">BH", descriptor, decimation) for descriptor in wanted)
    message_format = bytes((WRITE, SENSOR_DATA, len(wanted))) + entries
    return (
        command(COMMANDS_3DM, MESSAGE_FORMAT, message_format)
        + command(COMMANDS_3DM, DATA_STREAM, bytes((WRITE, SENSOR_DATA, ENABLE)))
        + command(BASE_COMMANDS, RESUME)
    )
