"""Messages and records of the map stream as bytes. See docs/map-stream.md."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from robominer_slam.publishing.map_state import DIGEST_BYTES, POSE
from robominer_slam.publishing.point_bytes import PointArray, PointBytesError, pack_points, unpack_points

MAGIC = b"RMAP"
FORMAT = 2
MAX_MESSAGE_BYTES = 4096
#: Of a body before compression, whatever it shrinks to: a receiver never has to hold more.
MAX_BODY_BYTES = 16_384
#: Points in one record: few enough that a message is filled well.
_CHUNK = 256

_HEADER = struct.Struct(f"<4sBBHQIIIHH{DIGEST_BYTES}s")
_KEYFRAME = struct.Struct("<BIqI")
_POINTS = struct.Struct("<BIH")
_POSE = struct.Struct("<BI")
_REMOVE = struct.Struct("<BI")
_MAX_PACKED_BYTES = MAX_MESSAGE_BYTES - _HEADER.size
_LEVEL = 9


class MapStreamError(ValueError):
    """Bytes that are no message of the map stream, or of a format this program does not know."""


class Kind(IntEnum):
    """Of a message: what changed since a version, or the whole state."""

    UPDATE = 1
    SNAPSHOT = 2


class _Tag(IntEnum):
    KEYFRAME = 1
    POINTS = 2
    POSE = 3
    REMOVE = 4


class Header(NamedTuple):
    """Of a message.

    Attributes:
        kind: update or snapshot.
        map_id: of the map.
        epoch: of the sender: another number after it was started anew.
        base_version: the version that an update changes; 0: the empty map.
        version: the version it leads to.
        part, parts: the messages of one update or snapshot, counted from 0.
        digest: of the state it leads to.
    """

    kind: Kind
    map_id: int
    epoch: int
    base_version: int
    version: int
    part: int
    parts: int
    digest: bytes

    @property
    def name(self) -> str:
        """What `answer=` in a query of `map/snapshot` calls the update or snapshot that this is a part of."""
        return f"{int(self.kind)}.{self.base_version}.{self.version}.{self.digest.hex()}"


class KeyframeRecord(NamedTuple):
    """A new keyframe; `point_count` points follow in points records."""

    id: int
    stamp_ns: int
    pose: tuple[int, ...]
    point_count: int


class PointsRecord(NamedTuple):
    """Some points of a keyframe, in the order of the whole."""

    id: int
    points: PointArray


class PoseRecord(NamedTuple):
    """A corrected pose of a keyframe."""

    id: int
    pose: tuple[int, ...]


class RemoveRecord(NamedTuple):
    """A keyframe that is no longer in the map."""

    id: int


Record: TypeAlias = KeyframeRecord | PointsRecord | PoseRecord | RemoveRecord


def pack_bodies(records: Iterable[Record]) -> list[bytes]:
    """Records in order, gathered into compressed bodies that each fit a message; at least one body."""
    bodies: list[bytes] = []
    filling = _Filling()
    for piece in _pieces(records):
        if not filling.take(piece):
            bodies.append(filling.packed)
            filling = _Filling()
            # A piece alone always fits: it is at most 2.4 KB.
            filling.take(piece)
    return [*bodies, filling.packed]


class _Filling:
    """A body that is being filled: takes pieces as long as it fits a message."""

    def __init__(self) -> None:
        self._deflater = zlib.compressobj(_LEVEL)
        self._out = b""
        self._size = 0
        self.packed = self._deflater.copy().flush()

    def take(self, piece: bytes) -> bool:
        """Append a piece; False if the message has no room for it."""
        tried = self._deflater.copy()
        out = self._out + tried.compress(piece)
        packed = out + tried.copy().flush()
        if len(packed) > _MAX_PACKED_BYTES or self._size + len(piece) > MAX_BODY_BYTES:
            return False
        self._deflater, self._out, self.packed = tried, out, packed
        self._size += len(piece)
        return True


def _pieces(records: Iterable[Record]) -> Iterator[bytes]:
    """Records packed; the points of a keyframe in several."""
    for record in records:
        if not isinstance(record, PointsRecord):
            yield _pack(record)
            continue
        for start in range(0, len(record.points), _CHUNK):
            yield _pack(PointsRecord(record.id, record.points[start : start + _CHUNK]))


def _pack(record: Record) -> bytes:
    match record:
        case KeyframeRecord(id=key, stamp_ns=stamp_ns, pose=pose, point_count=count):
            return _KEYFRAME.pack(_Tag.KEYFRAME, key, stamp_ns, count) + POSE.pack(*pose)
        case PointsRecord(id=key, points=points):
            return _POINTS.pack(_Tag.POINTS, key, len(points)) + pack_points(points)
        case PoseRecord(id=key, pose=pose):
            return _POSE.pack(_Tag.POSE, key) + POSE.pack(*pose)
        case RemoveRecord(id=key):
            return _REMOVE.pack(_Tag.REMOVE, key)


def unpack_records(body: bytes) -> list[Record]:
    """The records of a body.

    Raises:
        MapStreamError: bytes that are no records.
    """
    records: list[Record] = []
    at = 0
    try:
        while at < len(body):
            record, at = _unpack(body, at)
            records.append(record)
    except (struct.error, PointBytesError) as error:
        raise MapStreamError(f"a record that is cut or damaged: {error}") from error
    return records


def _unpack(body: bytes, at: int) -> tuple[Record, int]:
    tag = body[at]
    if tag == _Tag.KEYFRAME:
        _, key, stamp_ns, count = _KEYFRAME.unpack_from(body, at)
        at += _KEYFRAME.size
        return KeyframeRecord(key, stamp_ns, _unpack_pose(body, at), count), at + POSE.size
    if tag == _Tag.POINTS:
        _, key, count = _POINTS.unpack_from(body, at)
        at += _POINTS.size
        points, end = unpack_points(body, at, count)
        return PointsRecord(key, points), end
    if tag == _Tag.POSE:
        _, key = _POSE.unpack_from(body, at)
        at += _POSE.size
        return PoseRecord(key, _unpack_pose(body, at)), at + POSE.size
    if tag == _Tag.REMOVE:
        _, key = _REMOVE.unpack_from(body, at)
        return RemoveRecord(key), at + _REMOVE.size
    raise MapStreamError(f"a record of unknown kind {tag}")


def _unpack_pose(body: bytes, at: int) -> tuple[int, ...]:
    pose = POSE.unpack_from(body, at)
    if not any(pose[3:]):
        raise MapStreamError("a quaternion of no length")
    return pose


def pack_message(header: Header, packed: bytes) -> bytes:
    """One message of a body that is compressed already."""
    head = _HEADER.pack(MAGIC, FORMAT, header.kind, len(packed), *header[1:])
    return head + packed


def unpack_messages(data: bytes) -> Iterator[tuple[Header, bytes]]:
    """The messages in some bytes, one after the other, with their bodies decompressed.

    Raises:
        MapStreamError: bytes that are no message, or a format this program does not know.
    """
    at = 0
    while at < len(data):
        if len(data) - at < _HEADER.size or data[at : at + len(MAGIC)] != MAGIC:
            raise MapStreamError("no message of the map stream")
        _, version, kind, size, *fields = _HEADER.unpack_from(data, at)
        if version != FORMAT:
            raise MapStreamError(f"map stream of format {version}, expected {FORMAT}")
        at += _HEADER.size
        if kind not in tuple(Kind) or at + size > len(data):
            raise MapStreamError("a message that is cut or of an unknown kind")
        header = Header(Kind(kind), *fields)
        if header.part >= header.parts:
            raise MapStreamError(f"part {header.part} of {header.parts}")
        yield header, _decompress(data[at : at + size])
        at += size


def _decompress(packed: bytes) -> bytes:
    """At most `MAX_BODY_BYTES`, whatever the bytes claim to hold."""
    inflater = zlib.decompressobj()
    try:
        body = inflater.decompress(packed, MAX_BODY_BYTES + 1)
    except zlib.error as error:
        raise MapStreamError(f"a body that does not decompress: {error}") from error
    if len(body) > MAX_BODY_BYTES or not inflater.eof:
        raise MapStreamError("a body that is cut or too long")
    return body
