"""Keyframes kept in SQLite: one writer thread, batched commits, WAL with full sync.

What the back-end takes out of the graph is taken out here too, with its edges; the edges that bridge it are added.

Schema and tools are sqlite-utils' (imported only when a database is made); the rows of a drive are written with
plain SQL, since sqlite-utils costs 5 ms a row. A batch is on the disk at most `sync_s` after its oldest keyframe.
"""

from __future__ import annotations

import logging
import queue
import sqlite3
import threading
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe, Merge

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

SCHEMA_VERSION = 1
QUEUE_LENGTH = 256
#: Points are stored in millimetres: finer than the whiskers can tell.
POINT_UNIT_M = 0.001
UPPER = np.triu_indices(6)


class StoreError(ValueError):
    """A database that cannot be used; one line that says what, where and what to do."""


def pack_points(points: NDArray[np.floating]) -> bytes:
    """Points, shape (m, 3), m, as compressed int16 millimetres."""
    quantised = np.clip(np.rint(np.asarray(points) / POINT_UNIT_M), -32768, 32767).astype("<i2")
    return zlib.compress(quantised.tobytes(), 6)


def unpack_points(data: bytes) -> FloatArray:
    """Inverse of `pack_points`, shape (m, 3), m."""
    return np.frombuffer(zlib.decompress(data), dtype="<i2").reshape(-1, 3) * POINT_UNIT_M


def create_schema(path: Path) -> None:
    """Make the tables of a new database."""
    import sqlite_utils  # 25 MB and 0.2 s: only for a database that does not exist yet

    database = sqlite_utils.Database(str(path))
    try:
        database.enable_wal()
        database.create_table("maps", {"id": int, "name": str, "created_unix_ns": int, "robot": str}, pk="id")
        database.create_table(
            "keyframes",
            {
                "map_id": int,
                "id": int,
                "stamp_unix_ns": int,
                "T_odom_base": bytes,
                "T_map_base": bytes,
                "points": bytes,
            },
            pk=("map_id", "id"),
            foreign_keys=[("map_id", "maps", "id")],
        )
        database.create_table(
            "edges",
            {"map_id": int, "kind": str, "i": int, "j": int, "T_i_j": bytes, "information": bytes, "weight": float},
            foreign_keys=[("map_id", "maps", "id")],
        )
        database.execute("CREATE INDEX idx_edges_map_id_j ON edges (map_id, j)")
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    finally:
        database.close()


def open_database(path: Path) -> sqlite3.Connection:
    """Open or make the database of the maps.

    Raises:
        StoreError: the folder cannot be written, the file is no database or is newer than this program.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = not path.exists() or path.stat().st_size == 0
        if fresh:
            create_schema(path)
        connection = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
        version = int(connection.execute("PRAGMA user_version").fetchone()[0])
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"[store] path = {str(path)!r}: {error}; expected a writable folder and a database") from error
    if version != SCHEMA_VERSION:
        connection.close()
        raise StoreError(
            f"[store] path = {str(path)!r}: schema version {version}, this program knows {SCHEMA_VERSION}; "
            "update the program or name another file"
        )
    return connection


@dataclass(frozen=True, slots=True)
class _Change:
    """What a result changes in the store; without the poses of the whole map, since many may wait for the disk."""

    keyframe: Keyframe
    T_map_base: FloatArray
    edges: Sequence[GraphEdge]
    removed: Sequence[int]
    merged: Sequence[Merge]
    bare: Sequence[int]
    clock_offset_ns: int

    @classmethod
    def of(cls, result: BackendResult, clock_offset_ns: int) -> _Change:
        keyframe, edges = result.keyframe, result.added
        if edges is None:
            edges = [edge for edge in result.edges if edge.j == keyframe.id]
        pose = result.poses[-1].copy()
        return cls(keyframe, pose, edges, result.removed, result.merged, result.bare, clock_offset_ns)


class MapStore:
    """The thread `store`. Use as a context manager.

    Attributes:
        folder: where the database lies.
        written: keyframes on the disk.
        fault: why nothing is being written now; empty if all is well.
        dropped: keyframes that could not be written because the disk has been failing for long.
    """

    def __init__(self, path: Path, sync_s: float, robot: str, name: str) -> None:
        self.folder = path.parent
        self._connection = open_database(path)
        self._lock = threading.Lock()
        self._sync_s = sync_s
        self._queue: queue.Queue[_Change | None] = queue.Queue(QUEUE_LENGTH)
        self.map_id = self._start_map(robot, name)
        self.written = 0
        self.dropped = 0
        self.fault = ""
        self._failed: list[_Change] = []
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)

    def __enter__(self) -> MapStore:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.put(None)
        self._thread.join()
        self._connection.close()

    def add(self, result: BackendResult, clock_offset_ns: int) -> None:
        """Keep a result's keyframe and new edges, drop what left the graph; never waits for the disk."""
        try:
            self._queue.put_nowait(_Change.of(result, clock_offset_ns))
        except queue.Full:
            self.dropped += 1

    def save_poses(self, poses: FloatArray, ids: Sequence[int] | None = None) -> None:
        """Write the poses, shape (n, 4, 4), that the back-end has corrected since the keyframes were stored.

        Args:
            poses: of keyframes in map.
            ids: of these keyframes; 0, 1, 2, ... where not given.
        """
        keys = range(len(poses)) if ids is None else ids
        rows = [(_pack_pose(T), self.map_id, key) for key, T in zip(keys, poses, strict=True)]
        with self._lock:
            self._connection.execute("BEGIN IMMEDIATE")
            self._connection.executemany("UPDATE keyframes SET T_map_base = ? WHERE map_id = ? AND id = ?", rows)
            self._connection.execute("COMMIT")

    def rename(self, name: str) -> None:
        """Name the current map."""
        with self._lock:
            self._connection.execute("UPDATE maps SET name = ? WHERE id = ?", (name, self.map_id))

    def new_map(self, robot: str, name: str) -> None:
        """What is added from now on belongs to a new map."""
        self.flush(self._sync_s * 2)
        with self._lock:
            self.map_id = self._start_map(robot, name)

    def flush(self, timeout_s: float) -> bool:
        """Wait until what was added so far is on the disk; False if it took longer."""
        end = time.monotonic() + timeout_s
        while self._queue.unfinished_tasks:
            if time.monotonic() > end:
                return False
            time.sleep(0.01)
        return True

    def _start_map(self, robot: str, name: str) -> int:
        cursor = self._connection.execute(
            "INSERT INTO maps (name, created_unix_ns, robot) VALUES (?, ?, ?)", (name, time.time_ns(), robot)
        )
        return int(cursor.lastrowid or 0)

    def _run(self) -> None:
        stopping = False
        while not stopping:
            item = self._queue.get()
            batch = [] if item is None else [item]
            stopping = item is None
            taken = 1
            # Half the time that a keyframe may wait is for collecting, the rest for a slow card.
            end = time.monotonic() + self._sync_s / 2
            while not stopping and (left := end - time.monotonic()) > 0:
                try:
                    item = self._queue.get(timeout=left)
                except queue.Empty:
                    break
                taken += 1
                if item is None:
                    stopping = True
                else:
                    batch.append(item)
            self._write(self._failed + batch)
            for _ in range(taken):
                self._queue.task_done()

    def _write(self, batch: list[_Change]) -> None:
        if not batch:
            return
        try:
            with self._lock:
                self._connection.execute("BEGIN IMMEDIATE")
                for change in batch:
                    self._apply(change)
                self._connection.execute("COMMIT")
        except sqlite3.Error as error:
            # The robot goes on mapping in memory; the batch is tried again with the next one.
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            if not self.fault:
                log.error("the map cannot be stored: %s; mapping goes on in memory", error)
            self.fault = str(error)
            self.dropped += max(0, len(batch) - QUEUE_LENGTH)
            self._failed = batch[-QUEUE_LENGTH:]
            return
        self._failed = []
        self.fault = ""
        self.written += len(batch)

    def _apply(self, change: _Change) -> None:
        execute, many, map_id = self._connection.execute, self._connection.executemany, self.map_id
        keyframe = change.keyframe
        row = (
            map_id,
            keyframe.id,
            keyframe.stamp_ns + change.clock_offset_ns,
            _pack_pose(keyframe.T_odom_base),
            _pack_pose(change.T_map_base),
            pack_points(keyframe.points),
        )
        execute("INSERT OR REPLACE INTO keyframes VALUES (?, ?, ?, ?, ?, ?)", row)
        for merge in change.merged:
            self._merge(merge)
        many("UPDATE keyframes SET points = ? WHERE map_id = ? AND id = ?",
             [(pack_points(np.zeros((0, 3))), map_id, key) for key in change.bare])  # fmt: skip
        gone = [(map_id, key) for key in change.removed]
        many("DELETE FROM edges WHERE map_id = ? AND j = ?", gone)
        many("DELETE FROM edges WHERE map_id = ? AND i = ?", gone)
        many("DELETE FROM keyframes WHERE map_id = ? AND id = ?", gone)
        edges = [_edge_row(map_id, edge) for edge in change.edges]
        many("INSERT INTO edges VALUES (?, ?, ?, ?, ?, ?, ?)", edges)

    def _merge(self, merge: Merge) -> None:
        """Points of a keyframe into the frame of another."""
        execute = self._connection.execute
        found = execute(
            "SELECT id, points FROM keyframes WHERE map_id = ? AND id IN (?, ?)", (self.map_id, merge.into, merge.gone)
        )
        points = {key: unpack_points(data) for key, data in found}
        if len(points) == 2:
            moved = geometry.transform_points(merge.T_into_gone, points[merge.gone])
            packed = pack_points(np.concatenate([points[merge.into], moved]))
            execute("UPDATE keyframes SET points = ? WHERE map_id = ? AND id = ?", (packed, self.map_id, merge.into))


def _pack_pose(T: FloatArray) -> bytes:
    return np.asarray(geometry.to_vector7(T), dtype="<f8").tobytes()


def _edge_row(map_id: int, edge: GraphEdge) -> tuple[int, str, int, int, bytes, bytes, float]:
    information = edge.information[UPPER].astype("<f4").tobytes()
    return map_id, edge.kind, edge.i, edge.j, _pack_pose(edge.T_i_j), information, edge.weight
