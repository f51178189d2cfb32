"""The sender's end of the map stream: the map in, messages out. Bytes only, no network.

The format is in docs/map-stream.md.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.publishing import map_state
from robominer_slam.publishing.map_changes import MapChanges
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
from robominer_slam.publishing.map_state import MapState, StreamKeyframe
from robominer_slam.publishing.new_ground import new_ground

FloatArray = NDArray[np.float64]

#: Poses that moved less than this against what was sent last are not sent again, m and rad.
POSITION_TOLERANCE = 0.002
ANGLE_TOLERANCE = 0.001
#: Farther apart than this along an axis, keyframes of any of our arrays have no ground in common, mm.
REACH = 2000


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

    def __init__(self, map_id: int, cell: float | None = None) -> None:
        """Start with the empty map at version 0.

        Args:
            map_id: of the map, 64 bits.
            cell: one point is told of each cell of ground of this size, m; None: every point.
        """
        self.state = MapState(map_id)
        self.points_left_out = 0
        self._cell = cell
        self._changes = MapChanges()
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
        told = np.zeros(len(ids), dtype=np.bool_)
        told[:common] = True
        for place, (source, changed) in enumerate(zip(keyframes, moved.tolist(), strict=True)):
            if changed or self._sources.get(source.id) is not source.points:
                near = told & (np.abs(quantised[:, :3] - quantised[place, :3]) < REACH).all(axis=1)
                near[place], told[place] = False, True
                neighbours = [ids[k] for k in np.flatnonzero(near).tolist()] if self._cell is not None else []
                pose = tuple(quantised[place].tolist())
                records += self._take(version, source, pose, clock_offset_ns, neighbours)
                sent[place] = self.state.keyframes[source.id].pose
        for gone in sorted(self.state.keyframes.keys() - set(ids)):
            del self.state.keyframes[gone]
            del self._sources[gone]
            self._changes.removed(gone, version)
            records.append(RemoveRecord(gone))
        self._sent_ids, self._sent_poses = ids, sent
        self.state.version = version
        return self._messages(Kind.UPDATE, base, records)

    def changes(self, map_id: int, epoch: int, version: int) -> list[bytes] | None:
        """The messages that bring a receiver from a version to the present one; None if it needs the whole.

        Args:
            map_id, epoch: of the receiver's copy.
            version: of it.
        """
        if (map_id, epoch) != (self.state.map_id, self._epoch) or version > self.state.version:
            return None
        missed = self._changes.since(version)
        if missed is None:
            return None
        keyframes = self.state.keyframes
        records: list[Record] = [record for key in missed.whole for record in _new_keyframe(key, keyframes[key])]
        records += [PoseRecord(key, keyframes[key].pose) for key in missed.poses]
        records += [RemoveRecord(key) for key in missed.gone]
        return self._messages(Kind.UPDATE, version, records)

    def snapshot(self) -> list[bytes]:
        """The messages that carry the whole state."""
        records: list[Record] = []
        for key in sorted(self.state.keyframes):
            records += _new_keyframe(key, self.state.keyframes[key])
        return self._messages(Kind.SNAPSHOT, 0, records)

    def _take(
        self, version: int, source: SourceKeyframe, pose: tuple[int, ...], offset_ns: int, neighbours: list[int]
    ) -> list[Record]:
        known = self.state.keyframes.get(source.id)
        if known is None or self._sources[source.id] is not source.points:
            self._sources[source.id] = source.points
            points, left_out = map_state.quantise_points(source.points)
            self.points_left_out += left_out
            new = map_state.keyframe(source.stamp_ns + offset_ns, pose, points)
            if self._cell is not None:
                new = self._thinned(new, self._cell, neighbours)
            self.state.keyframes[source.id] = new
            self._changes.whole(source.id, version)
            return list(_new_keyframe(source.id, new))
        if not _moved(np.array([known.pose]), np.array([pose]))[0]:
            return []
        self.state.keyframes[source.id] = replace(known, pose=pose)
        self._changes.moved(source.id, version)
        return [PoseRecord(source.id, pose)]

    def _thinned(self, keyframe: StreamKeyframe, cell: float, neighbours: list[int]) -> StreamKeyframe:
        """The keyframe with the points whose ground its neighbours have not told."""
        T = geometry.from_vector7(keyframe.vector7())
        near = [self.state.keyframes[key] for key in neighbours]
        points = new_ground(keyframe.points, keyframe.points_m(), T, near, cell)
        return map_state.keyframe(keyframe.stamp_ns, keyframe.pose, points)

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


def _new_keyframe(key: int, keyframe: StreamKeyframe) -> Iterator[Record]:
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
