"""What the robot said of itself over the session, for scrubbing back: in memory of fixed size."""

from __future__ import annotations

import json
import zlib
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from robominer_slam.operator.status_entries import StatusEntry
from robominer_slam.publishing.report_messages import Level
from robominer_slam.publishing.telemetry import Health

#: An hour at the robot's rate, about 3 MB; when it is full, every second one of the older half goes.
CAPACITY = 3600


@dataclass(frozen=True, slots=True)
class PastStatus:
    """The entries and the health bits of a moment, UNIX ns."""

    stamp_ns: int
    entries: Sequence[StatusEntry]
    health: Health


class StatusHistory:
    """Statuses by time; the caller holds a lock."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity = capacity
        self._stamps: list[int] = []
        self._packed: list[bytes] = []

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, status: PastStatus) -> None:
        """Keep it, if it is later than the last one."""
        if self._stamps and status.stamp_ns <= self._stamps[-1]:
            return
        if len(self._stamps) >= self._capacity:
            older = self._capacity // 2
            del self._stamps[1:older:2], self._packed[1:older:2]
        entries = [(e.name, int(e.level), e.message, dict(e.values)) for e in status.entries]
        self._stamps.append(status.stamp_ns)
        self._packed.append(zlib.compress(json.dumps((int(status.health), entries)).encode()))

    def at(self, stamp_ns: int) -> PastStatus | None:
        """The last one at or before a time; None where there is none."""
        k = bisect_right(self._stamps, stamp_ns) - 1
        return self._unpacked(k) if k >= 0 else None

    def before(self, stamp_ns: int) -> PastStatus | None:
        """The one before that of `at`."""
        k = bisect_right(self._stamps, stamp_ns) - 2
        return self._unpacked(k) if k >= 0 else None

    def _unpacked(self, k: int) -> PastStatus:
        health, entries = json.loads(zlib.decompress(self._packed[k]))
        return PastStatus(
            self._stamps[k],
            tuple(StatusEntry(name, Level(level), message, values) for name, level, message, values in entries),
            Health(health),
        )
