"""Answers to queries of `map/snapshot`: the whole map or what a copy lacks, in portions that a slow link can take.

The parameters are in docs/map-stream.md. An answer that was begun is kept, so that who lost the link in the middle of
it goes on where it was, whatever has changed meanwhile: what came after it is had by another query.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from robominer_slam.publishing.map_records import unpack_messages
from robominer_slam.publishing.map_stream_encoder import MapStreamEncoder

#: Parameters that name a receiver's copy of the map.
COPY = ("map_id", "epoch", "since")
#: Answers that are kept: so many, of so many bytes together unless there is only one, for so long since they were used.
MAX_KEPT = 4
MAX_KEPT_BYTES = 4 << 20
KEEP_S = 900.0


class MapQueryError(ValueError):
    """Parameters that mean nothing; the message is one line."""


@dataclass(slots=True)
class _Kept:
    """An answer, and when it was last asked for."""

    messages: list[bytes]
    used_s: float


class MapAnswers:
    """Answers for one stream; the caller holds a lock."""

    def __init__(self, stream: MapStreamEncoder, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream = stream
        self._clock = clock
        #: By name; the one used last stands last.
        self._kept: dict[str, _Kept] = {}

    def answer(self, parameters: Mapping[str, str]) -> list[bytes]:
        """The messages that a query is answered with.

        Raises:
            MapQueryError: parameters that mean nothing.
        """
        known = {name: parameters[name] for name in COPY if name in parameters}
        numbers = [*known.values(), *(parameters[name] for name in ("part", "limit") if name in parameters)]
        if (known and known.keys() != set(COPY)) or not all(text.isdecimal() for text in numbers):
            raise MapQueryError(f"expected whole numbers in {'=, '.join(COPY)}=, or none of them, and in part=, limit=")
        self.forget_old()
        part = int(parameters.get("part", "0"))
        kept = self._kept.get(parameters.get("answer", ""))
        if kept is None or part >= len(kept.messages):
            kept, part = _Kept(self._new(known), 0.0), 0
        kept.used_s = self._clock()
        limit = parameters.get("limit")
        if limit is None:
            return kept.messages[part:]
        self._keep(kept)
        return _portion(kept.messages[part:], int(limit))

    def forget_old(self) -> None:
        """Let go of answers that nobody has asked for in a long time."""
        end = self._clock() - KEEP_S
        for name in [name for name, kept in self._kept.items() if kept.used_s < end]:
            del self._kept[name]

    def _new(self, known: Mapping[str, str]) -> list[bytes]:
        if known:
            changes = self._stream.changes(*(int(known[name]) for name in COPY))
            if changes is not None:
                return changes
        return self._stream.snapshot()

    def _keep(self, answer: _Kept) -> None:
        header, _ = next(unpack_messages(answer.messages[0]))
        name = header.name
        self._kept.pop(name, None)
        # One that came in a single message has nothing to go on with.
        if len(answer.messages) > 1:
            self._kept[name] = answer
        while len(self._kept) > 1 and (len(self._kept) > MAX_KEPT or self._bytes() > MAX_KEPT_BYTES):
            del self._kept[next(iter(self._kept))]

    def _bytes(self) -> int:
        return sum(len(message) for kept in self._kept.values() for message in kept.messages)


def _portion(messages: list[bytes], limit: int) -> list[bytes]:
    """As many messages from the first as a limit in bytes lets through, and at least one."""
    total = 0
    for count, message in enumerate(messages):
        total += len(message)
        if count and total > limit:
            return messages[:count]
    return messages
