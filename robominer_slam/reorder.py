"""Measurements of several ports brought into the order of their stamps.

A whisker frame is stamped with its first sensor's reading but arrives when its last sensor has been read, some 40 ms
later; by then the IMU and screws of that time have arrived too. So a frame releases everything up to its stamp.
Without frames, measurements are released once they are older than the window.
"""

from __future__ import annotations

from bisect import bisect_right

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
        # What waits, in the order of its stamps: nearly all comes in order, and is put at the end.
        self._stamps: list[int] = []
        self._waiting: list[tuple[str, Measurement]] = []
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
        at = bisect_right(self._stamps, stamp)
        self._stamps.insert(at, stamp)
        self._waiting.insert(at, (device, measurement))
        if isinstance(measurement, HallFrame):
            return self._release(stamp)
        due = self._release(stamp - self._window_ns)
        excess = len(self._stamps) - MAX_WAITING
        if excess > 0:
            del self._stamps[:excess], self._waiting[:excess]
            self.dropped += excess
        return due

    def flush(self) -> list[tuple[str, Measurement]]:
        """Everything that still waits, in order."""
        return self._release(self._stamps[-1]) if self._stamps else []

    def _release(self, until_ns: int) -> list[tuple[str, Measurement]]:
        if not self._stamps or self._stamps[0] > until_ns:
            return []
        count = bisect_right(self._stamps, until_ns)
        last_ns = self._stamps[count - 1]
        self._released_ns = last_ns if self._released_ns is None else max(last_ns, self._released_ns)
        due = self._waiting[:count]
        del self._stamps[:count], self._waiting[:count]
        return due
