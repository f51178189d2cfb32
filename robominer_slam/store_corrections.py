"""What the back-end has corrected since keyframes and edges were stored: only what differs is written again."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.keyframe import GraphEdge
from robominer_slam.store_changes import Change, pack_pose, unpack_pose
from robominer_slam.store_database import StoreError, open_to_read
from robominer_slam.store_versions import add_version

FloatArray = NDArray[np.float64]
#: Kind, i, j: an edge's name in its map.
EdgeKey = tuple[str, int, int]

#: Poses that moved less than this since they were written are not written again, m or (of the rotation) 1: while
#: driving, and when the map is saved.
POSE_TOLERANCE = 0.002
SAVED_TOLERANCE = 0.001


def edge_keys(path: Path, map_id: int) -> set[EdgeKey]:
    """Names of the edges of a stored map. Raises StoreError where they cannot be read."""
    try:
        with closing(open_to_read(path)) as connection:
            rows = connection.execute("SELECT kind, i, j FROM edges WHERE map_id = ?", (map_id,)).fetchall()
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"[store] path = {str(path)!r}: cannot be read: {error}") from error
    return {(str(kind), int(i), int(j)) for kind, i, j in rows}


class Corrections:
    """Poses and weights of the current map as they are on the disk.

    Args:
        stored: edges that the map has already, where it is gone on with.
    """

    def __init__(self, stored: Iterable[EdgeKey] = ()) -> None:
        self._poses: dict[int, FloatArray] = {}
        #: None: on the disk, but not known.
        self._weights: dict[EdgeKey, float | None] = dict.fromkeys(stored)

    def take(self, batch: Iterable[Change]) -> None:
        """These changes are on the disk now."""
        gone: set[int] = set()
        for change in batch:
            self._poses.update({keyframe.id: T for keyframe, T in change.keyframes})
            for i, j in change.dropped:
                self._weights.pop(("loop", i, j), None)
            self._weights.update({(e.kind, e.i, e.j): e.weight for e in change.edges})
            gone.update(change.removed)
        if gone:
            self._poses = {k: T for k, T in self._poses.items() if k not in gone}
            self._weights = {key: w for key, w in self._weights.items() if key[1] not in gone and key[2] not in gone}

    def write(
        self,
        connection: sqlite3.Connection,
        map_id: int,
        poses: FloatArray,
        ids: Iterable[int],
        edges: Sequence[GraphEdge],
        tolerance: float,
    ) -> None:
        """Write what differs, and the map's next version where poses do; `written` is to be called after it.

        All within a transaction of the caller's.
        """
        self._new_poses = {}
        farthest = 0.0
        for k, T in zip(ids, poses, strict=True):
            there = self._stored_pose(connection, map_id, k)
            if there is not None and np.abs(T - there).max() > tolerance:
                self._new_poses[k] = T
                farthest = max(farthest, float(np.linalg.norm(T[:3, 3] - there[:3, 3])))
        weights: dict[EdgeKey, float] = {}
        for e in edges:
            # Merged keyframes may leave two closures of one name: none counts if one was taken back.
            weights[e.kind, e.i, e.j] = min(e.weight, weights.get((e.kind, e.i, e.j), 1.0))
        self._new_weights = {key: w for key, w in weights.items() if self._weights.get(key) != w}
        pose_rows = [(pack_pose(T), map_id, k) for k, T in self._new_poses.items()]
        weight_rows = [(w, map_id, *key) for key, w in self._new_weights.items()]
        connection.executemany("UPDATE keyframes SET T_map_base = ? WHERE map_id = ? AND id = ?", pose_rows)
        connection.executemany(
            "UPDATE edges SET weight = ? WHERE map_id = ? AND kind = ? AND i = ? AND j = ?", weight_rows
        )
        if self._new_poses:
            loops = sum(kind == "loop" for kind, _, _ in self._weights)
            add_version(connection, map_id, loops, len(self._new_poses), farthest)

    def written(self) -> None:
        """What was written last is on the disk."""
        self._poses.update(self._new_poses)
        self._weights.update({key: w for key, w in self._new_weights.items() if key in self._weights})

    def _stored_pose(self, connection: sqlite3.Connection, map_id: int, k: int) -> FloatArray | None:
        """A keyframe's pose on the disk; None if the keyframe is not there yet."""
        if k not in self._poses:
            # Of a map that is gone on with; or the keyframe was written a moment ago, or still waits.
            row = connection.execute(
                "SELECT T_map_base FROM keyframes WHERE map_id = ? AND id = ?", (map_id, k)
            ).fetchone()
            if row is None:
                return None
            self._poses[k] = unpack_pose(row[0])
        return self._poses[k]
