"""The receiver's end of the map stream: messages in, the map out. Bytes only, no network.

What a receiver has to do is in docs/map-stream.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from drivers.counters import Counters
from robominer_slam.publishing import map_state
from robominer_slam.publishing.map_records import (
    Header,
    KeyframeRecord,
    Kind,
    MapStreamError,
    PointsRecord,
    PoseRecord,
    Record,
    RemoveRecord,
    unpack_messages,
    unpack_records,
)
from robominer_slam.publishing.map_state import MapState, StreamKeyframe
from robominer_slam.publishing.point_bytes import PointArray

#: Messages that wait for the rest of their update or for the update before: 64 MB at most. A whole map that
#: comes as a snapshot has to fit too.
MAX_WAITING_MESSAGES = 16_384
#: Streams (map, epoch) that were left and to which no late message leads back.
_REMEMBERED_STREAMS = 16

_Stream: TypeAlias = tuple[int, int]


@dataclass(slots=True)
class _Gathering:
    """The messages of one update or snapshot, as far as they have come; the header is that of part 0."""

    header: Header
    bodies: dict[int, bytes] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        return len(self.bodies) == self.header.parts

    def records(self) -> Iterable[Record]:
        for part in range(self.header.parts):
            yield from unpack_records(self.bodies[part])


class MapStreamDecoder:
    """Takes messages in any order, and whatever else comes, and never raises on it.

    Attributes:
        state: the newest map that is whole and whose digest holds; None before the first.
        needs_snapshot: True if what came cannot be used for want of something before it: query `map/snapshot`.
        counters: `updates` and `snapshots` taken; `stale` messages of what is known already; dropped:
            `bad_message`, `bad_content`, `digest_mismatch`, `overflow`.
    """

    def __init__(self) -> None:
        self.state: MapState | None = None
        self.needs_snapshot = False
        self.counters = Counters()
        self._stream: _Stream | None = None
        self._left: deque[_Stream] = deque(maxlen=_REMEMBERED_STREAMS)
        self._gathering: dict[Header, _Gathering] = {}

    @property
    def copy(self) -> dict[str, int]:
        """Parameters for a query of `map/snapshot` that asks only for what this copy lacks; none before the first."""
        if self.state is None or self._stream is None:
            return {}
        map_id, epoch = self._stream
        return {"map_id": map_id, "epoch": epoch, "since": self.state.version}

    def feed(self, data: bytes) -> bool:
        """Take one or more messages; True if the state changed."""
        changed = False
        try:
            for header, body in unpack_messages(data):
                changed |= self._take(header, body)
        except MapStreamError:
            self.counters["bad_message"] += 1
        return changed

    def first_missing(self, name: str) -> int | None:
        """Of an update or snapshot that is coming in parts, by `Header.name`, the first that is not there yet.

        None if no part is wanted: all are there, or it was taken, or is of no use any more.
        """
        for header, gathering in self._gathering.items():
            if header.name == name:
                return next((part for part in range(header.parts) if part not in gathering.bodies), None)
        return None

    def forget(self, name: str) -> None:
        """Let go of what came of an update or snapshot."""
        for header in [header for header in self._gathering if header.name == name]:
            del self._gathering[header]

    def _take(self, header: Header, body: bytes) -> bool:
        if self._stale(header):
            self.counters["stale"] += 1
            return False
        key = header._replace(part=0)
        gathering = self._gathering.setdefault(key, _Gathering(key))
        gathering.bodies[header.part] = body
        self._bound()
        return gathering.complete and self._apply_all()

    def _bound(self) -> None:
        """Let go of what waits longest where too much waits."""
        while sum(len(gathering.bodies) for gathering in self._gathering.values()) > MAX_WAITING_MESSAGES:
            del self._gathering[next(iter(self._gathering))]
            self.counters["overflow"] += 1
            self.needs_snapshot = True

    def _apply_all(self) -> bool:
        """Apply what is complete and fits, until nothing more does."""
        changed = False
        while (ready := self._ready()) is not None:
            del self._gathering[ready.header]
            changed |= self._apply(ready)
        waiting = any(gathering.complete for gathering in self._gathering.values())
        self.needs_snapshot = waiting or (self.needs_snapshot and not changed)
        return changed

    def _ready(self) -> _Gathering | None:
        for gathering in self._gathering.values():
            if gathering.complete and self._fits(gathering.header):
                return gathering
        return None

    def _fits(self, header: Header) -> bool:
        if header.kind is Kind.SNAPSHOT:
            return True
        if self.state is not None and _stream_of(header) == self._stream:
            return header.base_version == self.state.version
        return header.base_version == 0

    def _stale(self, header: Header) -> bool:
        stream = _stream_of(header)
        if self.state is not None and stream == self._stream:
            return header.version <= self.state.version
        return stream in self._left

    def _apply(self, gathering: _Gathering) -> bool:
        header = gathering.header
        known = {} if self.state is None or header.base_version == 0 else self.state.keyframes
        try:
            keyframes = apply_records(known, gathering.records())
        except MapStreamError:
            return self._refuse("bad_content")
        state = MapState(header.map_id, header.version, keyframes)
        if state.digest() != header.digest:
            return self._refuse("digest_mismatch")
        stream = _stream_of(header)
        if self._stream is not None and stream != self._stream:
            self._left.append(self._stream)
        self.state, self._stream = state, stream
        self.counters["snapshots" if header.kind is Kind.SNAPSHOT else "updates"] += 1
        for old in [key for key in self._gathering if self._stale(key)]:
            del self._gathering[old]
        return True

    def _refuse(self, reason: str) -> bool:
        self.counters[reason] += 1
        self.needs_snapshot = True
        return False


def _stream_of(header: Header) -> _Stream:
    return header.map_id, header.epoch


@dataclass(slots=True)
class _NewKeyframe:
    """A keyframe whose points have not all been read."""

    record: KeyframeRecord
    chunks: list[PointArray] = field(default_factory=list)


def apply_records(known: Mapping[int, StreamKeyframe], records: Iterable[Record]) -> dict[int, StreamKeyframe]:
    """The keyframes after the records; `known` stays as it is.

    Raises:
        MapStreamError: a record about a keyframe that is not there, or points that do not add up.
    """
    keyframes = dict(known)
    new: dict[int, _NewKeyframe] = {}
    for record in records:
        if isinstance(record, KeyframeRecord):
            new[record.id] = _NewKeyframe(record)
            continue
        place: Mapping[int, object] = new if isinstance(record, PointsRecord) else keyframes
        if record.id not in place:
            raise MapStreamError(f"a record about keyframe {record.id}, which is not there")
        match record:
            case PointsRecord(id=key, points=points):
                new[key].chunks.append(points)
            case PoseRecord(id=key, pose=pose):
                keyframes[key] = replace(keyframes[key], pose=pose)
            case RemoveRecord(id=key):
                del keyframes[key]
    for key, entry in new.items():
        points = np.concatenate([np.zeros((0, 3), dtype=np.int16), *entry.chunks])
        if len(points) != entry.record.point_count:
            raise MapStreamError(f"keyframe {key} with {len(points)} points of {entry.record.point_count}")
        keyframes[key] = map_state.keyframe(entry.record.stamp_ns, entry.record.pose, points)
    return keyframes
