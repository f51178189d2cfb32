"""Measurements of several ports brought into the order of their stamps.

A whisker frame is stamped with its first sensor's reading but arrives when its last sensor has been read, some 40 ms
later; by then the IMU and screws of that time have arrived too. So a frame releases everything up to its stamp.
Without frames, measurements are released once they are older than the window.
"""

from __future__ import annotations

import heapq
from itertools import count

from drivers.measurement import HallFrame, Measurement

#: Later than this behind what was released already, a measurement says nothing useful about now.
MAX_LATE_NS = 100_000_000
#: Bound on what waits: 0.5 s of a full robot is about 100.
MAX_WAITING = 4096


class ReorderBuffer:
    """Sorts measurements by stamp, triggered by whisker frames.

    Attributes:
        late: measurements that came after a newer one had been released; used if less than 0.1 s late.
        dropped: measurements later than that, or beyond the bound.
    """

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._heap: list[tuple[int, int, str, Measurement]] = []
        self._order = count()
        self._released_ns: int | None = None
        self.late = 0
        self.dropped = 0

    def add(self, device: str, measurement: Measurement) -> list[tuple[str, Measurement]]:
        """Add a measurement; return those that are due now, in order, as (device, measurement)."""
        stamp = measurement.stamp_ns
        if self._released_ns is not None and stamp < self._released_ns:
            self.late += 1
            if self._released_ns - stamp > MAX_LATE_NS:
                self.dropped += 1
                return []
        heapq.heappush(self._heap, (stamp, next(self._order), device, measurement))
        if isinstance(measurement, HallFrame):
            return self._release(stamp)
        due = self._release(stamp - self._window_ns)
        while len(self._heap) > MAX_WAITING:
            heapq.heappop(self._heap)
            self.dropped += 1
        return due

    def flush(self) -> list[tuple[str, Measurement]]:
        """Everything that still waits, in order."""
        return self._release(max((entry[0] for entry in self._heap), default=0))

    def _release(self, until_ns: int) -> list[tuple[str, Measurement]]:
        due = []
        while self._heap and self._heap[0][0] <= until_ns:
            stamp, _, device, measurement = heapq.heappop(self._heap)
            self._released_ns = stamp if self._released_ns is None else max(stamp, self._released_ns)
            due.append((device, measurement))
        return due
