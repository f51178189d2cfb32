"""Rows from a damaged database, told apart by their values, checked, and put together to maps that can be used."""

from __future__ import annotations

import sqlite3
import zlib

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.packed_points import pack_points, unpack_points
from robominer_slam.slam.keyframe import GraphEdge
from robominer_slam.store_changes import EdgeRow, edge_row
from robominer_slam.store_pages import Row, Value
from robominer_slam.store_versions import NUMBERS

FloatArray = NDArray[np.float64]
#: A keyframe's name: id of its map, its own.
Key = tuple[int, int]
Values = tuple[Value, ...]

POSE_BYTES = 56
INFORMATION_BYTES = 84
#: Farther from the origin is no robot of ours, m.
FARTHEST_M = 100_000.0
#: Uncertainty of an edge that stands for lost ones, m and rad: odometry over a metre or two.
BRIDGE_SIGMA = 0.1
LARGEST_ID = 1 << 40


def pose_fault(data: object) -> str:
    """What is wrong with a packed pose; empty if nothing."""
    if not isinstance(data, bytes) or len(data) != POSE_BYTES:
        return "pose of a wrong length"
    vector = np.frombuffer(data, dtype="<f8")
    if not np.isfinite(vector).all() or np.abs(vector[:3]).max() > FARTHEST_M:
        return "pose without finite place"
    if np.abs(vector[3:]).max() > 2.0 or abs(float(np.linalg.norm(vector[3:])) - 1.0) > 1e-6:
        return "pose without a rotation"
    return ""


def points_fault(data: object) -> str:
    """What is wrong with packed touches; empty if nothing."""
    if not isinstance(data, bytes):
        return "no touches"
    try:
        unpack_points(data)
    except (zlib.error, ValueError) as error:
        return f"touches: {error}"
    return ""


def keyframe_fault(T_odom_base: object, T_map_base: object, points: object) -> str:
    """What is wrong with a keyframe's row; empty if nothing."""
    return pose_fault(T_odom_base) or pose_fault(T_map_base) or points_fault(points)


class SalvagedRows:
    """What was found so far.

    Attributes:
        maps: id to rowid and row, without the id.
        keyframes: key to rowid and row.
        edges: by rowid.
        sessions: id to row, without the id.
        versions: id to row, of maps.
        without_touches: keyframes whose touches were damaged.
        bridges: edges that were added.
    """

    def __init__(self) -> None:
        self.maps: dict[int, tuple[Value, Value, Value]] = {}
        self.keyframes: dict[Key, tuple[int, Values]] = {}
        self.edges: dict[int, EdgeRow] = {}
        self.sessions: dict[int, Values] = {}
        self.versions: dict[int, Values] = {}
        self.without_touches = 0
        self.bridges = 0
        self._named: set[Key] = set()

    @property
    def lost(self) -> int:
        """Keyframes that edges or damaged rows tell of, and that are not here."""
        return len(self._named - self.keyframes.keys())

    def take(self, row: Row) -> None:
        """Keep a row, if it is one of our tables' and sound."""
        values = row.values
        match values:
            case (None, str() | None, int(), str()) if 0 < row.rowid < LARGEST_ID:
                self.maps[row.rowid] = values[1], values[2], values[3]
            case (None, int(), int(), str(), str()) if 0 < row.rowid < LARGEST_ID:
                self.sessions[row.rowid] = values[1:]
            case (None, int(map_id), int(number), int(), int(), int(), int(), int() | float() as moved_m):
                if row.rowid == map_id * NUMBERS + number and 0 < number < NUMBERS and 0.0 <= moved_m < FARTHEST_M:
                    self.versions[row.rowid] = row.rowid, *values[1:]
            case (int(number), int(identity), int(), _, _, _):
                if 0 < number < LARGEST_ID and 0 <= identity < LARGEST_ID:
                    self._take_keyframe((number, identity), row)
            case (int(number), "odometry" | "loop" as kind, int(i), int(j), bytes(T), bytes(information),
                  int() | float() as weight):  # fmt: skip
                finite = len(information) == INFORMATION_BYTES and np.isfinite(np.frombuffer(information, "<f4")).all()
                if finite and not pose_fault(T) and 0.0 <= weight <= 1.0 and 0 < number < LARGEST_ID and i != j:
                    self.edges[row.rowid] = number, kind, i, j, T, information, weight
            case _:
                pass  # of the schema or of an index, or its length or kind is damaged

    def _take_keyframe(self, key: Key, row: Row) -> None:
        stamp, T_odom_base, T_map_base, points = row.values[2:]
        self._named.add(key)
        if pose_fault(T_odom_base) or pose_fault(T_map_base):
            return
        known = self.keyframes.get(key)
        if known is not None and known[0] >= row.rowid:
            return  # written anew since: a greater rowid is a later row
        if points_fault(points):
            # Its place in the graph is worth more than its touches.
            points = pack_points(np.zeros((0, 3)))
            self.without_touches += 1
        self.keyframes[key] = row.rowid, (*key, stamp, T_odom_base, T_map_base, points)

    def bridge(self) -> None:
        """Drop edges to lost keyframes, and tie what hangs no more together by the poses of both sides."""
        self._named |= {(number, k) for number, _, i, j, *_ in self.edges.values() for k in (i, j)}
        kept = self.keyframes.keys()
        self.edges = {n: e for n, e in self.edges.items() if (e[0], e[2]) in kept and (e[0], e[3]) in kept}
        root = {key: key for key in kept}

        def find(key: Key) -> Key:
            while root[key] != key:
                root[key] = root[root[key]]
                key = root[key]
            return key

        for number, _, i, j, *_ in self.edges.values():
            a, b = sorted((find((number, i)), find((number, j))))
            root[b] = a
        free = max(self.edges, default=0) + 1
        before: Key | None = None
        for key in sorted(kept):
            if before is not None and before[0] == key[0] and find(key) == key:
                self.edges[free + self.bridges] = self._bridge(before, key)
                self.bridges += 1
                root[key] = find(before)
            before = key

    def _bridge(self, a: Key, b: Key) -> EdgeRow:
        T_a, T_b = (geometry.from_vector7(np.frombuffer(self._pose(key), "<f8")) for key in (a, b))
        information = np.eye(6) / BRIDGE_SIGMA**2
        return edge_row(a[0], GraphEdge("odometry", a[1], b[1], geometry.inverse(T_a) @ T_b, information, 1.0))

    def _pose(self, key: Key) -> bytes:
        pose = self.keyframes[key][1][4]
        assert isinstance(pose, bytes)  # pose_fault has seen it
        return pose

    def write(self, connection: sqlite3.Connection) -> None:
        """Put everything into the empty tables of a database."""
        many = connection.executemany
        for number in sorted({key[0] for key in self.keyframes} - self.maps.keys()):
            self.maps[number] = "", 0, ""
        many("INSERT INTO maps (id, name, created_unix_ns, robot) VALUES (?, ?, ?, ?)",
             [(number, *values) for number, values in sorted(self.maps.items())])  # fmt: skip
        many("INSERT INTO sessions VALUES (?, ?, ?, ?, ?)", [(n, *row) for n, row in sorted(self.sessions.items())])
        many("INSERT INTO versions VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
             [row for _, row in sorted(self.versions.items()) if row[1] in self.maps])  # fmt: skip
        many("INSERT INTO keyframes VALUES (?, ?, ?, ?, ?, ?)", [row for _, (_, row) in sorted(self.keyframes.items())])
        many("INSERT INTO edges VALUES (?, ?, ?, ?, ?, ?, ?)", [row for _, row in sorted(self.edges.items())])
