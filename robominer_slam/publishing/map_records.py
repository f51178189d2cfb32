"""Messages and records of the map stream as bytes. See docs/map-stream.md."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import NamedTuple, TypeAlias

import numpy as np

from robominer_slam.publishing.map_state import DIGEST_BYTES, POSE, PointArray

MAGIC = b"RMAP"
FORMAT = 1
MAX_MESSAGE_BYTES = 4096
#: Before compression. A body that does not compress grows by 11 bytes at most, so every message fits.
MAX_BODY_BYTES = 4000
#: A points record is not begun for fewer than this many points while more are to follow.
_MIN_CHUNK = 32

_HEADER = struct.Struct(f"<4sBBHQIIIHH{DIGEST_BYTES}s")
_KEYFRAME = struct.Struct("<BIqI")
_POINTS = struct.Struct("<BIH")
_POSE = struct.Struct("<BI")
_REMOVE = struct.Struct("<BI")
_POINT_BYTES = 6


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
    """Records in order, gathered into bodies of at most `MAX_BODY_BYTES`; at least one body."""
    bodies: list[bytes] = []
    body = b""
    for record in records:
        for size, packed in _pieces(record, MAX_BODY_BYTES - len(body)):
            if len(body) + size > MAX_BODY_BYTES:
                bodies.append(body)
                body = b""
            body += packed
    return [*bodies, body]


def _pieces(record: Record, room: int) -> Iterator[tuple[int, bytes]]:
    """A record packed; the points of a keyframe in pieces that fill the messages."""
    if not isinstance(record, PointsRecord):
        packed = _pack(record)
        yield len(packed), packed
        return
    points = record.points
    while len(points):
        fit = (room - _POINTS.size) // _POINT_BYTES
        if fit < min(_MIN_CHUNK, len(points)):
            fit = (MAX_BODY_BYTES - _POINTS.size) // _POINT_BYTES
            room = MAX_BODY_BYTES
        packed = _pack(PointsRecord(record.id, points[:fit]))
        yield len(packed), packed
        points = points[fit:]
        room -= len(packed)


def _pack(record: Record) -> bytes:
    match record:
        case KeyframeRecord(id=key, stamp_ns=stamp_ns, pose=pose, point_count=count):
            return _KEYFRAME.pack(_Tag.KEYFRAME, key, stamp_ns, count) + POSE.pack(*pose)
        case PointsRecord(id=key, points=points):
            # Sorted by x, so that its differences are small and compress; they wrap modulo 2^16.
            columns = points.T.astype("<i2")
            columns[0, 1:] -= points[:-1, 0]
            return _POINTS.pack(_Tag.POINTS, key, len(points)) + columns.tobytes()
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
    except struct.error as error:
        raise MapStreamError(f"a record that is cut: {error}") from error
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
        end = at + count * _POINT_BYTES
        if end > len(body):
            raise MapStreamError(f"a record of {count} points that is cut")
        columns = np.frombuffer(body, dtype="<i2", count=3 * count, offset=at).reshape(3, count)
        points = columns.T.astype(np.int16)
        points[:, 0] = np.cumsum(columns[0], dtype=np.int16)
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


def pack_message(header: Header, body: bytes) -> bytes:
    """One message; the body is compressed here."""
    packed = zlib.compress(body)
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
