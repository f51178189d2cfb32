"""Counts of what a decoder or device took and dropped, by reason."""

from __future__ import annotations

from collections import Counter


class Counters(Counter[str]):
    """A `collections.Counter` whose text is one stable line, for logs and status."""

    def line(self) -> str:
        """All counts that are not zero, sorted by name: `bad_crc=3 frames=120`."""
        return " ".join(f"{name}={count}" for name, count in sorted(self.items()) if count)
