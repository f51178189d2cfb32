"""What comes over the link: messages and bytes by key over the last seconds, and when nothing came."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

#: Rates are means over this many seconds.
WINDOW_S = 5.0
#: Without a pose or telemetry for this long the link counts as cut, s; both come four times a second or more.
OUTAGE_S = 1.5
KEPT_OUTAGES = 100
#: Bound on what is remembered of one key: 5 s at 200 Hz.
_KEPT_MESSAGES = 1000


@dataclass(frozen=True, slots=True)
class Outage:
    """A time without poses.

    Attributes:
        begin_s: by the monotonic clock.
        length_s: how long.
    """

    begin_s: float
    length_s: float


class Traffic:
    """Counts messages; the caller holds a lock. Times are of the local monotonic clock, s."""

    def __init__(self) -> None:
        self.outages: deque[Outage] = deque(maxlen=KEPT_OUTAGES)
        self.outage_count = 0
        self.outage_total_s = 0.0
        self.bytes_total = 0
        self._messages: dict[str, deque[tuple[float, int]]] = {}
        self._last_live_s: float | None = None

    def count(self, key: str, size: int, now_s: float, *, live: bool) -> None:
        """Take note of a message; `live` messages are those that tell where the robot is."""
        self.bytes_total += size
        self._messages.setdefault(key, deque(maxlen=_KEPT_MESSAGES)).append((now_s, size))
        if not live:
            return
        last, self._last_live_s = self._last_live_s, now_s
        if last is not None and now_s - last > OUTAGE_S:
            self.outages.append(Outage(last, now_s - last))
            self.outage_count += 1
            self.outage_total_s += now_s - last

    def age_s(self, key: str, now_s: float) -> float | None:
        """Since the last message of a key; None before the first."""
        messages = self._messages.get(key)
        return now_s - messages[-1][0] if messages else None

    def live_age_s(self, now_s: float) -> float | None:
        """Since the robot was last heard; None before the first time."""
        return None if self._last_live_s is None else now_s - self._last_live_s

    def rate_hz(self, key: str, now_s: float) -> float:
        """Messages per second, over the last seconds."""
        return len(self._recent(key, now_s)) / WINDOW_S

    def kilobits_per_s(self, now_s: float, key: str | None = None) -> float:
        """Payload of one key or of all, over the last seconds."""
        keys = list(self._messages) if key is None else [key]
        return sum(size for k in keys for _, size in self._recent(k, now_s)) * 8e-3 / WINDOW_S

    def keys(self) -> list[str]:
        """Keys that ever came."""
        return sorted(self._messages)

    def _recent(self, key: str, now_s: float) -> list[tuple[float, int]]:
        return [entry for entry in self._messages.get(key, ()) if now_s - entry[0] <= WINDOW_S]
