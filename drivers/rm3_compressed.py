"""Decoder of `rm3-compressed`: the RM3 whisker firmware's packed frames, i16 hundredths ended by CR LF.

A frame has no header and no check, and CR LF may occur among its values. So a frame counts only between two
terminators at the right distance, and only after terminators at that distance have come three times in a row (the
beginning of the stream stands for one). Sans-IO; what comes out does not depend on how the bytes were cut.
"""

from __future__ import annotations

import numpy as np

from drivers.counters import Counters
from drivers.readings import HallReading, Reading
from drivers.rm3_values import Representation, hall_reading, values_per_sensor

END = b"\r\n"
#: Terminators in a row, each a frame behind the last, that make a lock.
LOCK = 3
#: With several phases to choose from (values that look like CR LF and do not change), wait for this many in a row.
PATIENCE = 8


class Rm3CompressedDecoder:
    """Bytes of one port to frames.

    Attributes:
        counters: `packets` taken; `lost_lock` when a terminator was not where it should be; `dropped_bytes` that
            belong to no frame; `out_of_range` sensors whose values no sensor can give.
    """

    def __init__(self, rows: int, cols: int, representation: Representation) -> None:
        """Frames of rows x cols sensors; with `spherical` the magnitude may be there or not: both are tried."""
        self.counters = Counters()
        self._shape = rows, cols
        self._representation = representation
        self._lengths = {2 * rows * cols * n + len(END): n for n in values_per_sensor(representation)}
        self._longest = max(self._lengths)
        self._buffer = bytearray()
        self._start = 0  # place of the buffer's first byte in the stream
        self._scanned = 0  # terminators before this place are in the chains
        self._locked = 0  # length of a frame, 0 while searching
        # For each length, the terminators seen: place in the stream -> how many in a row end there.
        self._chains: dict[int, dict[int, int]] = {length: {-len(END): 1} for length in self._lengths}

    def feed(self, data: bytes) -> list[Reading]:
        """Take some bytes; return the frames that they complete."""
        readings: list[Reading] = []
        self._buffer += data
        while self._take_frames(readings) or self._search():
            pass
        return readings

    def _take_frames(self, readings: list[Reading]) -> bool:
        """Take frames while locked; True where the lock was lost and bytes are left to search."""
        length = self._locked
        if not length:
            return False
        buffer, at = self._buffer, 0
        while len(buffer) - at >= length:
            if buffer[at + length - 2 : at + length] != END:
                self._locked = 0
                self.counters["lost_lock"] += 1
                break
            readings.append(self._frame(bytes(buffer[at : at + length - 2]), self._lengths[length]))
            at += length
        self._drop(at)
        if self._locked:
            return False
        # The terminator just before is a good one: whole frames may follow after what was damaged.
        self._chains = {one: {self._start - len(END): 1} for one in self._lengths}
        self._scanned = self._start
        return True

    def _search(self) -> bool:
        """Look for terminators in a row; True where a lock was found."""
        if self._locked:
            return False
        while True:
            found = self._buffer.find(END, self._scanned - self._start)
            if found < 0:
                # A CR at the end may be half a terminator.
                self._scanned = max(self._scanned, self._start + max(len(self._buffer) - 1, 0))
                self._forget(self._scanned)
                return False
            place = self._start + found
            self._scanned = place + 1
            for length, chains in self._chains.items():
                chains[place] = chains.get(place - length, 0) + 1
            for length in self._lengths:
                best = self._choose(place, length)
                if best is not None:
                    self._lock(best, length)
                    return True
            self._forget(place)

    def _choose(self, place: int, length: int) -> int | None:
        """The terminator to lock to, if what ends at `place` settles it."""
        chains = self._chains[length]
        if chains[place] < LOCK:
            return None
        rivals = [other for other in chains if place - length < other < place and chains[other] >= LOCK - 1]
        if not rivals:
            return place
        if chains[place] < PATIENCE:
            return None
        return max([place, *rivals], key=lambda end: self._plausibility(end, length))

    def _plausibility(self, end: int, length: int) -> float:
        """Share of the values before a terminator that fit what the firmware sends: Bz, polar and magnitude >= 0."""
        at = end + len(END) - length - self._start
        if at < 0:
            return 0.0
        count = self._lengths[length]
        values = np.frombuffer(bytes(self._buffer[at : at + length - 2]), "<i2").reshape(-1, count)
        return float(np.mean(values[:, 1:] >= 0 if self._representation != "cartesian" else values[:, 2] >= 0))

    def _lock(self, place: int, length: int) -> None:
        """Lock to the terminator at `place`; the frames between the terminators of its row are good too."""
        begin = place + len(END) - (self._chains[length][place] - 1) * length
        kept = -(-(max(self._start - begin, 0)) // length) * length
        skip = begin + kept - self._start
        if skip:
            self.counters["dropped_bytes"] += skip
            self._drop(skip)
        self._locked = length

    def _forget(self, until: int) -> None:
        """Keep the buffer and the chains bounded while searching."""
        surplus = until - self._start - (PATIENCE + 2) * self._longest
        if surplus > 0:
            self.counters["dropped_bytes"] += surplus
            self._drop(surplus)
        for length, chains in self._chains.items():
            if len(chains) > 2 and next(iter(chains)) < until - length:
                self._chains[length] = {at: row for at, row in chains.items() if at >= until - length}

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._start += count

    def _frame(self, body: bytes, count: int) -> HallReading:
        self.counters["packets"] += 1
        values = np.frombuffer(body, dtype="<i2").reshape(*self._shape, count) * 0.01
        reading, out_of_range = hall_reading(values, self._representation)
        if out_of_range:
            self.counters["out_of_range"] += out_of_range
        return reading
