"""A MicroStrain 3DM-CV7 on the MIP protocol: sensor packets out, idle and streaming commands in.

Packet: 75 65, descriptor set, payload length, fields, Fletcher checksum. Field: length with its two header bytes,
descriptor, data, big-endian. Layouts are those of the MicroStrain MIP documentation: sensor data set 0x80 (0x04
scaled acceleration, 0x05 scaled gyro), shared data (0xD3 GPS time stamp: double time of week, u16 week, u16 valid
flags; 0xD5 reference time stamp: u64 nanoseconds since power-up), base commands 0x01 and 3DM commands 0x0C.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SYNC = b"\x75\x65"
SENSOR_DATA, BASE_COMMANDS, COMMANDS_3DM = 0x80, 0x01, 0x0C
ACCELERATION, GYRO, GPS_TIME, REFERENCE_TIME = 0x04, 0x05, 0xD3, 0xD5
PING, SET_IDLE, DEVICE_INFO, RESUME = 0x01, 0x02, 0x03, 0x06
BASE_RATE, MESSAGE_FORMAT, DATA_STREAM = 0x0E, 0x0F, 0x11
DEVICE_INFO_REPLY, BASE_RATE_REPLY, MESSAGE_FORMAT_REPLY, DATA_STREAM_REPLY = 0x81, 0x8E, 0x8F, 0x85
ACK = 0xF1
OK, UNKNOWN_COMMAND, INVALID_PARAMETER = 0x00, 0x01, 0x03
WRITE, READ = 1, 2
#: The sensors' base rate, Hz, of which a message format takes every n-th sample.
SENSOR_BASE_RATE = 1000
STANDARD_GRAVITY = 9.80665
#: base_link's x forward, y left, z up in the device's x forward, y right, z down.
Z_DOWN = np.array([1.0, -1.0, -1.0])
#: How the device wakes: waiting for Resume, at work, or as unpacked, with no message format and no stream.
PowerUp: TypeAlias = Literal["idle", "streaming", "unconfigured"]
#: Longest packet: four bytes of header, 255 of payload, two of checksum.
_LONGEST = 261


def fletcher(data: bytes) -> bytes:
    """The two check bytes over everything before them."""
    first = second = 0
    for byte in data:
        first = (first + byte) & 0xFF
        second = (second + first) & 0xFF
    return bytes([first, second])


def field(descriptor: int, data: bytes) -> bytes:
    """One field with its header."""
    return bytes([len(data) + 2, descriptor]) + data


def packet(descriptor_set: int, fields: Iterable[bytes]) -> bytes:
    """One packet with header and checksum."""
    payload = b"".join(fields)
    framed = SYNC + bytes([descriptor_set, len(payload)]) + payload
    return framed + fletcher(framed)


class MipDevice:
    """The device: it keeps its mode and message format, and answers commands.

    Attributes:
        commands: packets of commands received with a good checksum.
    """

    def __init__(self, power_up: PowerUp = "idle", sample_rate: float = 100.0) -> None:
        """Switch the device on.

        Args:
            power_up: its mode.
            sample_rate: at which samples will be given to `sample`, Hz.
        """
        self.commands = 0
        self._idle = power_up != "streaming"
        self._enabled = power_up != "unconfigured"
        self._ticks_per_sample = max(1, round(SENSOR_BASE_RATE / sample_rate))
        standard = [(name, self._ticks_per_sample) for name in (GPS_TIME, REFERENCE_TIME, ACCELERATION, GYRO)]
        self._format: list[tuple[int, int]] = standard if power_up != "unconfigured" else []
        self._ticks = 0
        self._buffer = b""

    @property
    def streaming(self) -> bool:
        """Whether samples go out."""
        return self._enabled and not self._idle and bool(self._format)

    def sample(self, time_us: int, gyro: FloatArray, acceleration: FloatArray) -> bytes:
        """The packet for one sample, empty where the mode or the message format wants none.

        Args:
            time_us: device's time since power-up, us, not wrapped.
            gyro: shape (3,), rad/s, x forward, y left, z up.
            acceleration: specific force, shape (3,), m/s2, same axes; at rest the device's z then shows -1 g.
        """
        self._ticks += self._ticks_per_sample
        if not self.streaming:
            return b""
        contents = {
            # No pulse per second is connected: the GPS time is the time since power-up, marked invalid.
            GPS_TIME: struct.pack(">dHH", time_us * 1e-6, 0, 0),
            REFERENCE_TIME: struct.pack(">Q", max(0, 1000 * time_us)),
            ACCELERATION: struct.pack(">3f", *(acceleration * Z_DOWN / STANDARD_GRAVITY)),
            GYRO: struct.pack(">3f", *(gyro * Z_DOWN)),
        }
        # A format that asks for more than there are samples gets what there is.
        due = [field(name, contents[name]) for name, decimation in self._format if self._due(decimation)]
        return packet(SENSOR_DATA, due) if due else b""

    def _due(self, decimation: int) -> bool:
        return self._ticks % max(decimation, self._ticks_per_sample) < self._ticks_per_sample

    def feed(self, data: bytes) -> list[bytes]:
        """Answers to what the host has sent, in any fragmentation; what has a bad checksum gets none."""
        self._buffer += data
        answers = []
        while (start := self._buffer.find(SYNC)) >= 0:
            candidate = self._buffer[start:]
            if len(candidate) < 4 or len(candidate) < candidate[3] + 6:
                break
            size = candidate[3] + 6
            if fletcher(candidate[: size - 2]) == candidate[size - 2 : size]:
                self.commands += 1
                answers.append(self._answer(candidate[2], candidate[4 : size - 2]))
                self._buffer = candidate[size:]
            else:
                self._buffer = candidate[1:]
        self._buffer = self._buffer[-_LONGEST:]
        return answers

    def _answer(self, descriptor_set: int, payload: bytes) -> bytes:
        replies: list[bytes] = []
        while len(payload) >= 2 and 2 <= payload[0] <= len(payload):
            descriptor, data, payload = payload[1], payload[2 : payload[0]], payload[payload[0] :]
            error, reply = self._command(descriptor_set, descriptor, data)
            replies.append(field(ACK, bytes([descriptor, error])))
            if reply:
                replies.append(reply)
        return packet(descriptor_set, replies)

    def _command(self, descriptor_set: int, descriptor: int, data: bytes) -> tuple[int, bytes]:
        """Error code and reply field, which may be empty."""
        command = descriptor_set, descriptor
        if command == (BASE_COMMANDS, PING):
            return OK, b""
        if command in ((BASE_COMMANDS, SET_IDLE), (BASE_COMMANDS, RESUME)):
            self._idle = descriptor == SET_IDLE
            return OK, b""
        if command == (BASE_COMMANDS, DEVICE_INFO):
            return OK, field(DEVICE_INFO_REPLY, _device_info())
        if command == (COMMANDS_3DM, BASE_RATE):
            if data != bytes([SENSOR_DATA]):
                return INVALID_PARAMETER, b""
            return OK, field(BASE_RATE_REPLY, struct.pack(">BH", SENSOR_DATA, SENSOR_BASE_RATE))
        if command == (COMMANDS_3DM, MESSAGE_FORMAT):
            return self._message_format(data)
        if command == (COMMANDS_3DM, DATA_STREAM):
            return self._data_stream(data)
        return UNKNOWN_COMMAND, b""

    def _message_format(self, data: bytes) -> tuple[int, bytes]:
        if len(data) < 2 or data[1] != SENSOR_DATA:
            return INVALID_PARAMETER, b""
        if data[0] == READ:
            entries = b"".join(struct.pack(">BH", *entry) for entry in self._format)
            return OK, field(MESSAGE_FORMAT_REPLY, bytes([SENSOR_DATA, len(self._format)]) + entries)
        if data[0] != WRITE or len(data) < 3 or len(data) != 3 + 3 * data[2]:
            return INVALID_PARAMETER, b""
        wanted = list(struct.iter_unpack(">BH", data[3:]))
        if any(name not in (GPS_TIME, REFERENCE_TIME, ACCELERATION, GYRO) or not d for name, d in wanted):
            return INVALID_PARAMETER, b""
        self._format = [(int(name), int(decimation)) for name, decimation in wanted]
        return OK, b""

    def _data_stream(self, data: bytes) -> tuple[int, bytes]:
        # Set 0 stands for all sets.
        if len(data) < 2 or data[1] not in (0, SENSOR_DATA):
            return INVALID_PARAMETER, b""
        if data[0] == READ:
            return OK, field(DATA_STREAM_REPLY, bytes([data[1], self._enabled]))
        if data[0] != WRITE or len(data) != 3:
            return INVALID_PARAMETER, b""
        self._enabled = bool(data[2])
        return OK, b""


def _device_info() -> bytes:
    """Firmware version and five texts of 16 characters: model name, model and serial number, lot, options."""
    texts = ("3DM-CV7-AHRS", "6286-9970", "6286.000001", "", "simulated")
    return struct.pack(">H", 1001) + b"".join(text.ljust(16).encode() for text in texts)
