"""The sender's end of the map stream: the map in, messages out. Bytes only, no network.

The format is in docs/map-stream.md.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robominer_slam.publishing import map_state
from robominer_slam.publishing.map_records import (
    Header,
    KeyframeRecord,
    Kind,
    PointsRecord,
    PoseRecord,
    Record,
    RemoveRecord,
    pack_bodies,
    pack_message,
)
from robominer_slam.publishing.map_state import MapState

FloatArray = NDArray[np.float64]

#: Poses that moved less than this against what was sent last are not sent again, m and rad.
POSITION_TOLERANCE = 0.002
ANGLE_TOLERANCE = 0.001
#: Of an answer to a query: well below what receivers refuse (1 MiB).
MAX_PAYLOAD_BYTES = 512 * 1024


class SourceKeyframe(Protocol):
    """What the encoder needs of a keyframe; its points (m, 3), m, in base_link are another array when they change."""

    @property
    def id(self) -> int:
        """Number of the keyframe, unique in the map."""

    @property
    def stamp_ns(self) -> int:
        """Time of the keyframe."""

    @property
    def points(self) -> NDArray[np.floating]:
        """Contact points in base_link at that time, shape (m, 3), m."""


class MapStreamEncoder:
    """The sender's end.

    Attributes:
        state: what receivers hold that got everything.
        points_left_out: points that the format cannot carry (not finite, or over 32 m from their keyframe).
    """

    def __init__(self, map_id: int) -> None:
        """Start with the empty map at version 0.

        Args:
            map_id: of the map, 64 bits.
        """
        self.state = MapState(map_id)
        self.points_left_out = 0
        self._sources: dict[int, NDArray[np.floating]] = {}
        self._sent_ids: list[int] = []
        self._sent_poses = np.zeros((0, 7), dtype=np.int32)
        self._epoch = secrets.randbits(32)

    def update(
        self,
        version: int,
        keyframes: Sequence[SourceKeyframe],
        poses: FloatArray,
        clock_offset_ns: int = 0,
    ) -> list[bytes]:
        """Take the map as it is now; the messages that bring receivers from the last version to this one.

        Args:
            version: above the last one.
            keyframes: all keyframes of the map.
            poses: T_map_base of each: x y z (m), qx qy qz qw; shape (n, 7).
            clock_offset_ns: added to stamps to make them UNIX time.

        Raises:
            ValueError: the version does not grow, or keyframes and poses differ in number.
        """
        if version <= self.state.version:
            raise ValueError(f"map version {version} after {self.state.version}")
        quantised = map_state.quantise_poses(poses)
        if len(quantised) != len(keyframes):
            raise ValueError(f"{len(quantised)} poses of {len(keyframes)} keyframes")
        base = self.state.version
        records: list[Record] = []
        ids = [source.id for source in keyframes]
        common = _common_length(ids, self._sent_ids)
        sent = quantised.copy()
        moved = np.ones(len(ids), dtype=np.bool_)
        moved[:common] = _moved(self._sent_poses[:common], quantised[:common])
        sent[:common][~moved[:common]] = self._sent_poses[:common][~moved[:common]]
        for place, (source, changed) in enumerate(zip(keyframes, moved.tolist(), strict=True)):
            if changed or self._sources.get(source.id) is not source.points:
                records += self._take(source, tuple(quantised[place].tolist()), clock_offset_ns)
                sent[place] = self.state.keyframes[source.id].pose
        for gone in sorted(self.state.keyframes.keys() - set(ids)):
            del self.state.keyframes[gone]
            del self._sources[gone]
            records.append(RemoveRecord(gone))
        self._sent_ids, self._sent_poses = ids, sent
        self.state.version = version
        return self._messages(Kind.UPDATE, base, records)

    def snapshot(self) -> list[bytes]:
        """The messages that carry the whole state."""
        records: list[Record] = []
        for key in sorted(self.state.keyframes):
            records += _new_keyframe(key, self.state.keyframes[key])
        return self._messages(Kind.SNAPSHOT, 0, records)

    def snapshot_payloads(self, max_bytes: int = MAX_PAYLOAD_BYTES) -> list[bytes]:
        """The snapshot's messages, concatenated: one payload but for large maps."""
        payloads = [b""]
        for message in self.snapshot():
            if len(payloads[-1]) + len(message) > max_bytes:
                payloads.append(b"")
            payloads[-1] += message
        return payloads

    def _take(self, source: SourceKeyframe, pose: tuple[int, ...], clock_offset_ns: int) -> Iterable[Record]:
        known = self.state.keyframes.get(source.id)
        if known is None or self._sources[source.id] is not source.points:
            self._sources[source.id] = source.points
            points, left_out = map_state.quantise_points(source.points)
            self.points_left_out += left_out
            new = map_state.keyframe(source.stamp_ns + clock_offset_ns, pose, points)
            self.state.keyframes[source.id] = new
            return _new_keyframe(source.id, new)
        if not _moved(np.array([known.pose]), np.array([pose]))[0]:
            return ()
        self.state.keyframes[source.id] = replace(known, pose=pose)
        return (PoseRecord(source.id, pose),)

    def _messages(self, kind: Kind, base_version: int, records: list[Record]) -> list[bytes]:
        bodies = pack_bodies(records)
        digest = self.state.digest()
        state = self.state
        return [
            pack_message(
                Header(kind, state.map_id, self._epoch, base_version, state.version, part, len(bodies), digest),
                body,
            )
            for part, body in enumerate(bodies)
        ]


def _new_keyframe(key: int, keyframe: map_state.StreamKeyframe) -> Iterator[Record]:
    yield KeyframeRecord(key, keyframe.stamp_ns, keyframe.pose, len(keyframe.points))
    if len(keyframe.points):
        yield PointsRecord(key, keyframe.points)


def _common_length(a: list[int], b: list[int]) -> int:
    """How many ids two lists have in common at their beginning."""
    shorter = min(len(a), len(b))
    if a[:shorter] == b[:shorter]:
        return shorter
    return next(k for k in range(shorter) if a[k] != b[k])


def _moved(old: NDArray[np.int32], new: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which poses, shape (n, 7), have moved enough to be sent again, shape (n,)."""
    off = np.abs(new.astype(np.int64) - old)
    far = off[:, :3] >= POSITION_TOLERANCE * map_state.MILLIMETRES_PER_METRE
    # A small turn by an angle changes the quaternion by half of it.
    turned = off[:, 3:] >= 0.5 * ANGLE_TOLERANCE * map_state.QUATERNION_UNIT
    return np.asarray(far.any(axis=1) | turned.any(axis=1))
