"""The robot's side of the map stream on the bus: publishes what changed, answers queries of `map/snapshot`.

An update that fits one message is published as it is. A larger one, such as a correction of the whole map, goes out in
payloads that are too large for remote links (tls_settings.py): pushed at once, it would hold up the poses there for
seconds. Remote receivers see by `telemetry` that they are behind, and fetch it in portions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robominer_slam.publishing.bus_messages import Query, QueryRefusedError, Reply
from robominer_slam.publishing.map_answers import MapAnswers, MapQueryError
from robominer_slam.publishing.map_state import MapState
from robominer_slam.publishing.map_stream import MAX_MESSAGE_BYTES, MapStreamEncoder
from robominer_slam.publishing.map_stream_encoder import SourceKeyframe

#: Of an answer to a query without `limit=`: well below what receivers refuse (1 MiB).
MAX_PAYLOAD_BYTES = 512 * 1024
#: Of a payload of a large update: few enough that a link within the machine takes it in one piece.
_LARGE_PAYLOAD_BYTES = 32 * 1024


class Putting(Protocol):
    """What is needed of a `ZenohBus`."""

    def put(self, key: str, payload: bytes) -> None:
        """Publish."""


class MapPublisher:
    """Publishes one map; the caller holds a lock."""

    def __init__(self, bus: Putting, map_id: int, cell: float | None) -> None:
        """Start with the empty map.

        Args:
            bus: to publish on.
            map_id: of the map, 64 bits.
            cell: see `MapStreamEncoder`.
        """
        self._bus = bus
        self._stream = MapStreamEncoder(map_id, cell)
        self._answers = MapAnswers(self._stream)

    @property
    def state(self) -> MapState:
        """What receivers hold that have got everything."""
        return self._stream.state

    @property
    def digest(self) -> str:
        """Of the state, as `status` tells it."""
        return self._stream.state.digest().hex()

    def update(
        self, version: int, keyframes: Sequence[SourceKeyframe], poses: NDArray[np.float64], clock_offset_ns: int = 0
    ) -> None:
        """Publish what changed; parameters as of `MapStreamEncoder.update`."""
        self._answers.forget_old()
        for payload in update_payloads(self._stream.update(version, keyframes, poses, clock_offset_ns)):
            self._bus.put("map/updates", payload)

    def answer(self, query: Query) -> list[Reply]:
        """The whole stream state or what a copy lacks, in portions where they are asked for: docs/map-stream.md.

        Raises:
            QueryRefusedError: a parameter that means nothing.
        """
        try:
            messages = self._answers.answer(query.parameters)
        except MapQueryError as error:
            raise QueryRefusedError(str(error)) from error
        # Where portions are asked for, one by one, so that what is more urgent comes in between.
        limit = 0 if "limit" in query.parameters else MAX_PAYLOAD_BYTES
        return [Reply(payload) for payload in _joined(messages, limit)]


def update_payloads(messages: list[bytes]) -> list[bytes]:
    """An update's messages as they are published: one alone, or in payloads that are all larger than any message."""
    if len(messages) == 1:
        return messages
    payloads = _joined(messages, _LARGE_PAYLOAD_BYTES)
    if len(payloads) > 1 and len(payloads[-1]) <= MAX_MESSAGE_BYTES:
        last = payloads.pop()
        payloads[-1] += last
    return payloads


def _joined(messages: list[bytes], limit: int) -> list[bytes]:
    """Messages concatenated into payloads of at most a limit, or of one message where that is larger."""
    payloads = [messages[0]]
    for message in messages[1:]:
        if len(payloads[-1]) + len(message) > limit:
            payloads.append(message)
        else:
            payloads[-1] += message
    return payloads
