"""Monotonic time to UNIX time, for publishing: inside, everything runs on the monotonic clock."""

from __future__ import annotations

import time

RESAMPLE_NS = 1_000_000_000


class WallClock:
    """Offset between the two clocks, sampled once a second: the wall clock may be stepped at any time.

    Attributes:
        offset_ns: UNIX time minus monotonic time.
        steps: how often the wall clock was seen to jump by more than 10 ms.
    """

    def __init__(self) -> None:
        self.steps = 0
        self.offset_ns = self._sample()
        self._sampled_ns = time.monotonic_ns()

    def unix_ns(self, monotonic_ns: int) -> int:
        """UNIX time of a monotonic time, ns."""
        now = time.monotonic_ns()
        if now - self._sampled_ns > RESAMPLE_NS:
            offset = self._sample()
            if abs(offset - self.offset_ns) > 10_000_000:
                self.steps += 1
            self.offset_ns = offset
            self._sampled_ns = now
        return monotonic_ns + self.offset_ns

    def now_unix_ns(self) -> int:
        """UNIX time now, ns."""
        return self.unix_ns(time.monotonic_ns())

    @staticmethod
    def _sample() -> int:
        # The middle of three: a sample that was interrupted between its two reads is off by the interruption.
        return sorted(time.time_ns() - time.monotonic_ns() for _ in range(3))[1]
