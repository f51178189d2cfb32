"""The device's side of the `framed` protocol, written from the interface description alone.

Every packet: type u8, version u8, sequence u16, device_time u32, payload, CRC-32 of all before; COBS-encoded, ended
by one 0x00; little-endian.
"""

from __future__ import annotations

import struct
from zlib import crc32

import numpy as np
from cobs import cobs
from numpy.typing import ArrayLike, NDArray

VERSION = 1
HALL, IMU, ENCODERS, MOTORS, ODOMETRY, HELLO, PONG = 0x01, 0x02, 0x03, 0x04, 0x05, 0x70, 0x71
PING, REZERO, IDENTIFY = 0xF0, 0xF1, 0xF2
HALL_STEP_MT = 0.01
_HEADER = struct.Struct("<BBHI")
_U32 = struct.Struct("<I")
#: The longest packet that a host may send, encoded; longer ones are noise.
LONGEST_COMMAND = 64


class FramedEncoder:
    """Makes one device's packets; it counts a sequence for each type."""

    def __init__(self) -> None:
        self._sequence: dict[int, int] = {}

    def hall(
        self,
        device_time_us: int,
        rows: int,
        cols: int,
        period_us: int,
        valid: NDArray[np.bool_],
        field_mT: NDArray[np.float64],
    ) -> bytes:
        """A frame of the array: valid of shape (rows * cols,), field of shape (rows * cols, 3), mT, row-major."""
        bitmap = np.packbits(valid, bitorder="little").tobytes()
        counts = np.clip(np.rint(field_mT / HALL_STEP_MT), -32768, 32767).astype("<i2")
        payload = struct.pack("<BBH", rows, cols, period_us) + bitmap + counts.tobytes()
        return self._packet(HALL, device_time_us, payload)

    def imu(self, device_time_us: int, gyro: ArrayLike, acceleration: ArrayLike) -> bytes:
        """Angular rate, rad/s, and specific force, m/s2, three values each."""
        payload = np.concatenate([np.asarray(gyro), np.asarray(acceleration)]).astype("<f4").tobytes()
        return self._packet(IMU, device_time_us, payload)

    def encoders(self, device_time_us: int, ticks: ArrayLike) -> bytes:
        """Cumulative counts of the screws; they wrap modulo 2^32."""
        wrapped = (np.asarray(ticks, dtype=np.int64) & 0xFFFFFFFF).astype("<u4")
        return self._packet(ENCODERS, device_time_us, struct.pack("<B", len(wrapped)) + wrapped.tobytes())

    def motors(self, device_time_us: int, motors: ArrayLike) -> bytes:
        """Speed (rpm), current (mA) and voltage (V) of each screw, shape (n, 3)."""
        values = np.asarray(motors).astype("<f4")
        return self._packet(MOTORS, device_time_us, struct.pack("<B", len(values)) + values.tobytes())

    def odometry(self, device_time_us: int, velocity: ArrayLike) -> bytes:
        """Body velocity vx, vy, wz, m/s, m/s, rad/s."""
        return self._packet(ODOMETRY, device_time_us, np.asarray(velocity).astype("<f4").tobytes())

    def hello(self, device_time_us: int, text: str) -> bytes:
        """Name and version of the firmware."""
        return self._packet(HELLO, device_time_us, text.encode())

    def pong(self, device_time_us: int, nonce: int) -> bytes:
        """Answer to a PING, with the device's clock now."""
        return self._packet(PONG, device_time_us, _U32.pack(nonce))

    def _packet(self, kind: int, device_time_us: int, payload: bytes) -> bytes:
        sequence = self._sequence.get(kind, 0)
        self._sequence[kind] = (sequence + 1) & 0xFFFF
        body = _HEADER.pack(kind, VERSION, sequence, device_time_us & 0xFFFFFFFF) + payload
        encoded: bytes = cobs.encode(body + _U32.pack(crc32(body)))
        return encoded + b"\0"


class CommandDecoder:
    """Finds the host's commands in what it sends, in any fragmentation.

    Attributes:
        rejected: pieces between two zeros that were no command.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.rejected = 0

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Commands that these bytes complete, as (type, payload)."""
        *pieces, rest = (self._buffer + data).split(b"\0")
        self._buffer = rest if len(rest) <= LONGEST_COMMAND else b""
        commands = []
        for piece in pieces:
            command = _command(piece)
            if command is not None:
                commands.append(command)
            elif piece:
                self.rejected += 1
        return commands


def _command(piece: bytes) -> tuple[int, bytes] | None:
    try:
        packet = cobs.decode(piece)
    except cobs.DecodeError:
        return None
    if len(packet) < _HEADER.size + _U32.size or _U32.unpack(packet[-4:])[0] != crc32(packet[:-4]):
        return None
    kind, version, _, _ = _HEADER.unpack_from(packet)
    return (kind, packet[_HEADER.size : -4]) if version == VERSION else None
