"""Decoder of `rm3-motor`: what one screw's Arduino says of its speed.

`SYNC`, i8 motor id, i8 length (wrong in the firmware, so ignored), f32 rpm and perhaps f32 mA and f32 V, one byte
that is the XOR of all before it up to the header, `CNYS`; little-endian. `CNYS` may occur among the floats, so the
trailer counts only where one of the two forms ends. Sans-IO.
"""

from __future__ import annotations

import struct
from functools import reduce
from operator import xor

from drivers.counters import Counters
from drivers.readings import RADIANS_PER_SECOND_PER_RPM, Reading, ScrewReading

HEADER, TRAILER = b"SYNC", b"CNYS"
#: Bytes between header and trailer: without and with current and voltage.
SHORT, LONG = 7, 15
SCREW_COUNT = 4
_RPM = struct.Struct("<f")
_ALL = struct.Struct("<3f")


class Rm3MotorDecoder:
    """Bytes of one port to speeds of one screw.

    Attributes:
        counters: `packets` taken; dropped: `bad_check`, `bad_frame` (no trailer where one should be),
            `unknown_screw` (an id beyond 0 to 3); `dropped_bytes` outside messages.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._buffer = bytearray()
        self._long_before = False

    def feed(self, data: bytes) -> list[Reading]:
        """Take some bytes; return the readings that they complete."""
        readings: list[Reading] = []
        buffer = self._buffer
        buffer += data
        at = 0
        while True:
            start = buffer.find(HEADER, at)
            if start < 0:
                # The end may be the beginning of a header.
                keep = max(at, len(buffer) - len(HEADER) + 1)
                self._drop(keep - at)
                at = keep
                break
            self._drop(start - at)
            at = start
            size = self._size(at)
            if size is None:
                break
            if size:
                body = bytes(buffer[at + len(HEADER) : at + len(HEADER) + size])
                at += len(HEADER) + size + len(TRAILER)
                self._long_before = size == LONG
                reading = self._read(body)
                if reading is not None:
                    readings.append(reading)
            else:
                self._drop(1)
                at += 1
        del buffer[:at]
        return readings

    def _drop(self, count: int) -> None:
        if count:
            self.counters["dropped_bytes"] += count

    def _size(self, at: int) -> int | None:
        """The form of the message at a header: its size, 0 where it is none, None where bytes are missing yet.

        A long message may look like a short one, so a port that sends long ones is given the time to end them. A
        port that sends short ones is not: its next message is 200 ms away.
        """
        ended = False
        for size in (LONG, SHORT) if self._long_before else (SHORT, LONG):
            end = at + len(HEADER) + size
            if len(self._buffer) < end + len(TRAILER):
                return None
            if self._buffer[end : end + len(TRAILER)] == TRAILER:
                ended = True
                if reduce(xor, self._buffer[at + len(HEADER) : end]) == 0:
                    return size
        self.counters["bad_check" if ended else "bad_frame"] += 1
        return 0

    def _read(self, body: bytes) -> ScrewReading | None:
        screw = body[0]
        if screw >= SCREW_COUNT:
            self.counters["unknown_screw"] += 1
            return None
        self.counters["packets"] += 1
        current: float | None = None
        voltage: float | None = None
        if len(body) == LONG:
            rpm, current, voltage = _ALL.unpack_from(body, 2)
        else:
            (rpm,) = _RPM.unpack_from(body, 2)
        return ScrewReading(None, None, screw, float(rpm * RADIANS_PER_SECOND_PER_RPM), current, voltage)
