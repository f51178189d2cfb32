r"""Decoder of `rm3-plaintext`: one frame a line, `{[x;y;z]...}` for each row of the multiplexer, two decimals.

Sans-IO. The line has no check but its form, which is taken strictly: a line with another number of rows, sensors or
decimals is dropped whole.
"""

from __future__ import annotations

import re

import numpy as np

from drivers.counters import Counters
from drivers.readings import HallReading, Reading
from drivers.rm3_values import Representation, hall_reading, values_per_sensor

#: Up to this many characters a sensor: `[-1000.00;-1000.00;-1000.00]` has 28.
SENSOR_CHARACTERS = 32
#: What Arduino's `print` makes of a number that is not finite or too large.
NUMBER = rb"(?:-?\d{1,4}\.\d\d|-?nan|-?inf|-?ovf)"
_TO_SPACES = bytes.maketrans(b"{}[];", b"     ")


class Rm3PlaintextDecoder:
    """Bytes of one port to frames.

    Attributes:
        counters: `packets` taken; dropped: `bad_line`, `too_long`; `not_finite` numbers, `out_of_range` sensors.
    """

    def __init__(self, rows: int, cols: int, representation: Representation) -> None:
        """Frames of rows x cols sensors."""
        self.counters = Counters()
        self._shape = rows, cols
        self._representation = representation
        self._longest = rows * (cols * SENSOR_CHARACTERS + 2)
        self._buffer = bytearray()
        self._skipping = False
        self._lines = {count: _line_pattern(rows, cols, count) for count in reversed(values_per_sensor(representation))}

    def feed(self, data: bytes) -> list[Reading]:
        """Take some bytes; return the frames that they complete."""
        readings: list[Reading] = []
        self._buffer += data
        *lines, rest = self._buffer.split(b"\n")
        for line in lines:
            if self._skipping or len(line) > self._longest:
                self._too_long(ends=True)
                continue
            reading = self._frame(bytes(line))
            if reading is not None:
                readings.append(reading)
        self._buffer = rest
        if self._skipping or len(rest) > self._longest:
            self._too_long(ends=False)
            self._buffer.clear()
        return readings

    def _too_long(self, *, ends: bool) -> None:
        """Count a line beyond the bound once, whether it came in one piece or in many."""
        if not self._skipping:
            self.counters["too_long"] += 1
        self._skipping = not ends

    def _frame(self, line: bytes) -> HallReading | None:
        line = line.removesuffix(b"\r")
        count = next((count for count, pattern in self._lines.items() if pattern.fullmatch(line)), 0)
        if not count:
            self.counters["bad_line"] += 1
            return None
        if b"ovf" in line:
            line = line.replace(b"ovf", b"inf")
        numbers = list(map(float, line.translate(_TO_SPACES).split()))
        values = np.array(numbers).reshape(*self._shape, count)
        reading, out_of_range = hall_reading(values, self._representation)
        if out_of_range:
            self.counters["out_of_range"] += out_of_range
        if b"n" in line and (not_finite := int(np.count_nonzero(~np.isfinite(values)))):
            self.counters["not_finite"] += not_finite
        self.counters["packets"] += 1
        return reading


def _line_pattern(rows: int, cols: int, count: int) -> re.Pattern[bytes]:
    sensor = rb"\[" + b";".join([NUMBER] * count) + rb"\]"
    return re.compile(rb"(?:\{(?:%b){%d}\}){%d}" % (sensor, cols, rows))
