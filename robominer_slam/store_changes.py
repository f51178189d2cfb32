"""What a result of the back-end changes in the store, and the plain SQL that does it."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from robominer_slam import __version__, geometry
from robominer_slam.packed_points import pack_points, unpack_points
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe, Merge

FloatArray = NDArray[np.float64]
#: A row of `edges`: map, kind, the two keyframes, packed pose and information, weight.
EdgeRow: TypeAlias = tuple[int, str, int, int, bytes, bytes, float]
UPPER = np.triu_indices(6)


@dataclass(slots=True)
class MapRow:
    """A map that keyframes go into; its row is made with the first of them where the disk was full before.

    Attributes:
        robot, name: of the map.
        voxel_m: touches of a keyframe in a cube of this size are stored as one; 0 for all.
        id: None until the row is in the database.
        found: what the check at the start found, for the log of sessions.
        logged: whether this session is in that log.
    """

    robot: str
    name: str
    id: int | None = None
    voxel_m: float = 0.0
    found: str = ""
    logged: bool = False

    def ensure(self, connection: sqlite3.Connection) -> int:
        """Its id; makes the row if there is none yet, and logs the session."""
        if self.id is None:
            values = (self.name, time.time_ns(), self.robot)
            cursor = connection.execute("INSERT INTO maps (name, created_unix_ns, robot) VALUES (?, ?, ?)", values)
            self.id = int(cursor.lastrowid or 0)
        if not self.logged:
            connection.execute(
                "INSERT INTO sessions (map_id, started_unix_ns, program, found) VALUES (?, ?, ?, ?)",
                (self.id, time.time_ns(), __version__, self.found),
            )
            self.logged = True
        return self.id


@dataclass(frozen=True, slots=True)
class Change:
    """What a result changes; without the poses of the whole map, since many may wait for the disk.

    Attributes:
        row: the map that it belongs to.
        keyframes: new ones, with their poses in map.
        edges: new ones.
        dropped, removed, merged, bare: as in `BackendResult`.
        clock_offset_ns: added to stamps.
    """

    row: MapRow
    keyframes: Sequence[tuple[Keyframe, FloatArray]]
    edges: Sequence[GraphEdge]
    dropped: Sequence[tuple[int, int]]
    removed: Sequence[int]
    merged: Sequence[Merge]
    bare: Sequence[int]
    clock_offset_ns: int

    @classmethod
    def of(cls, row: MapRow, result: BackendResult, edges: Sequence[GraphEdge], clock_offset_ns: int) -> Change:
        """What is to be stored of a result."""
        place = {k: n for n, k in enumerate(result.keyframe_ids)} if result.new_keyframes else {}
        keyframes = [(k, result.poses[place[k.id]].copy()) for k in result.new_keyframes]
        return cls(row, keyframes, edges, result.dropped, result.removed, result.merged, result.bare, clock_offset_ns)

    def without_keyframes(self) -> Change:
        """What is left of it when its keyframes are lost."""
        return replace(self, keyframes=())

    def apply(self, connection: sqlite3.Connection) -> None:
        """Write it, within a transaction of the caller's."""
        many, map_id = connection.executemany, self.row.ensure(connection)
        rows = [
            (
                map_id,
                keyframe.id,
                keyframe.stamp_ns + self.clock_offset_ns,
                pack_pose(keyframe.T_odom_base),
                pack_pose(T_map_base),
                pack_points(keyframe.points, self.row.voxel_m),
            )
            for keyframe, T_map_base in self.keyframes
        ]
        many("INSERT OR REPLACE INTO keyframes VALUES (?, ?, ?, ?, ?, ?)", rows)
        for merge in self.merged:
            _merge(connection, map_id, merge, self.row.voxel_m)
        many("UPDATE keyframes SET points = ? WHERE map_id = ? AND id = ?",
             [(pack_points(np.zeros((0, 3))), map_id, key) for key in self.bare])  # fmt: skip
        gone = [(map_id, key) for key in self.removed]
        many("DELETE FROM edges WHERE map_id = ? AND j = ?", gone)
        many("DELETE FROM edges WHERE map_id = ? AND i = ?", gone)
        many("DELETE FROM keyframes WHERE map_id = ? AND id = ?", gone)
        many("DELETE FROM edges WHERE map_id = ? AND kind = 'loop' AND i = ? AND j = ?",
             [(map_id, i, j) for i, j in self.dropped])  # fmt: skip
        edges = [edge_row(map_id, edge) for edge in self.edges]
        many("INSERT INTO edges VALUES (?, ?, ?, ?, ?, ?, ?)", edges)


def _merge(connection: sqlite3.Connection, map_id: int, merge: Merge, voxel_m: float) -> None:
    """Points of a keyframe into the frame of another."""
    found = connection.execute(
        "SELECT id, points FROM keyframes WHERE map_id = ? AND id IN (?, ?)", (map_id, merge.into, merge.gone)
    )
    points = {key: unpack_points(data) for key, data in found}
    if len(points) == 2:
        moved = geometry.transform_points(merge.T_into_gone, points[merge.gone])
        packed = pack_points(np.concatenate([points[merge.into], moved]), voxel_m)
        connection.execute("UPDATE keyframes SET points = ? WHERE map_id = ? AND id = ?", (packed, map_id, merge.into))


def pack_pose(T: FloatArray) -> bytes:
    """A pose as 56 bytes: x y z qx qy qz qw."""
    return np.asarray(geometry.to_vector7(T), dtype="<f8").tobytes()


def unpack_pose(data: bytes) -> FloatArray:
    """The pose in such bytes, shape (4, 4)."""
    vector = np.frombuffer(data, dtype="<f8")
    return geometry.pose_matrix(vector[:3], vector[3:])


def edge_row(map_id: int, edge: GraphEdge) -> EdgeRow:
    """An edge as a row of `edges`."""
    information = edge.information[UPPER].astype("<f4").tobytes()
    return map_id, edge.kind, edge.i, edge.j, pack_pose(edge.T_i_j), information, edge.weight
