"""Keyframes kept in SQLite: one writer thread, batched commits, WAL with full sync.

Schema and tools are sqlite-utils' (imported only when a database is made); the rows of a drive are written with
plain SQL, since sqlite-utils costs 5 ms a row. A batch is on the disk at most `sync_s` after its oldest keyframe.
Poses that the back-end has moved since are written every few seconds, the weights of edges with them: a process
that is killed loses no more than that.
"""

from __future__ import annotations

import logging
import queue
import sqlite3
import threading
import time
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.keyframe import BackendResult, GraphEdge

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]
#: Kind, i, j: an edge's name in its map.
EdgeKey = tuple[str, int, int]

SCHEMA_VERSION = 1
QUEUE_LENGTH = 256
#: Points are stored in millimetres: finer than the whiskers can tell.
POINT_UNIT_M = 0.001
UPPER = np.triu_indices(6)
#: From one writing of corrected poses to the next, s: each costs a page per few keyframes.
POSES_INTERVAL_S = 4.0
#: Poses that moved less than this since they were written are not written again, m or (of the rotation) 1.
POSE_TOLERANCE = 0.001


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
class Item:
    """What one result adds to the map: its keyframes are written with these edges; stamps get the offset, ns."""

    result: BackendResult
    edges: tuple[GraphEdge, ...]
    clock_offset_ns: int


class MapStore:
    """The thread `store`. Use as a context manager.

    Attributes:
        written: keyframes on the disk.
        fault: why nothing is being written now; empty if all is well.
        dropped: keyframes that could not be written because the disk has been failing for long.
        frozen: whether the map must stay as it is: nothing is written then.
    """

    def __init__(
        self, path: Path, sync_s: float, robot: str, name: str, map_id: int | None = None, frozen: bool = False
    ) -> None:
        """Open the database; keyframes go into a new map, or are added to that of `map_id`, which may be frozen."""
        self._connection = open_database(path)
        self._lock = threading.Lock()
        self._sync_s = sync_s
        self._queue: queue.Queue[Item | None] = queue.Queue(QUEUE_LENGTH)
        self.map_id = self._start_map(robot, name) if map_id is None else map_id
        self._edges_seen = self._stored_edges() if map_id is not None else set()
        self._moved: BackendResult | None = None
        self._poses_written: dict[int, FloatArray] = {}
        self._weights_written: dict[EdgeKey, float] = {}
        self._poses_time = time.monotonic()
        self.frozen = frozen
        self.written = 0
        self.dropped = 0
        self.fault = ""
        self._failed: list[Item] = []
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)

    def __enter__(self) -> MapStore:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.put(None)
        self._thread.join()
        self._connection.close()

    def add(self, result: BackendResult, clock_offset_ns: int) -> None:
        """Keep a result's new keyframes and edges, and in time its poses; never waits for the disk."""
        if self.frozen:
            return
        edges = tuple(e for e in result.edges if (e.kind, e.i, e.j) not in self._edges_seen)
        try:
            self._queue.put_nowait(Item(result, edges, clock_offset_ns))
        except queue.Full:
            self.dropped += len(result.new_keyframes)
            return
        self._edges_seen.update((e.kind, e.i, e.j) for e in edges)

    def save_poses(self, poses: FloatArray, ids: Iterable[int] | None = None, edges: Sequence[GraphEdge] = ()) -> None:
        """Write what the back-end has corrected since the keyframes were stored.

        Args:
            poses: of the keyframes, shape (n, 4, 4).
            ids: of these keyframes; None for 0, 1, 2, ...
            edges: of the graph, whose weights may have changed.
        """
        if self.frozen:
            return
        self._moved = None
        self._update(poses, range(len(poses)) if ids is None else ids, edges)

    def _update(self, poses: FloatArray, ids: Iterable[int], edges: Sequence[GraphEdge]) -> None:
        places = dict(zip(ids, poses, strict=True))
        moved = {k: T for k, T in places.items() if self._differs(k, T)}
        weights: dict[EdgeKey, float] = {(e.kind, e.i, e.j): e.weight for e in edges}
        weights = {key: w for key, w in weights.items() if self._weights_written.get(key) != w}
        pose_rows = [(_pack_pose(T), self.map_id, k) for k, T in moved.items()]
        weight_rows = [(w, self.map_id, *key) for key, w in weights.items()]
        with self._lock:
            self._connection.execute("BEGIN IMMEDIATE")
            self._connection.executemany("UPDATE keyframes SET T_map_base = ? WHERE map_id = ? AND id = ?", pose_rows)
            self._connection.executemany(
                "UPDATE edges SET weight = ? WHERE map_id = ? AND kind = ? AND i = ? AND j = ?", weight_rows
            )
            self._connection.execute("COMMIT")
        self._poses_written.update(moved)
        self._weights_written.update(weights)

    def _differs(self, k: int, T: FloatArray) -> bool:
        written = self._poses_written.get(k)
        return written is None or bool(np.abs(T - written).max() > POSE_TOLERANCE)

    def rename(self, name: str) -> None:
        """Name the current map."""
        with self._lock:
            self._connection.execute("UPDATE maps SET name = ? WHERE id = ?", (name, self.map_id))

    def new_map(self, robot: str, name: str) -> None:
        """What is added from now on belongs to a new map."""
        self.flush(self._sync_s * 2)
        with self._lock:
            self.map_id = self._start_map(robot, name)
        self.frozen = False
        self._edges_seen = set()
        self._moved = None
        self._poses_written, self._weights_written = {}, {}

    @property
    def waiting(self) -> int:
        """Results that have not been written yet; beyond QUEUE_LENGTH they are dropped."""
        return self._queue.qsize()

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

    def _stored_edges(self) -> set[EdgeKey]:
        rows = self._connection.execute("SELECT kind, i, j FROM edges WHERE map_id = ?", (self.map_id,))
        return {(str(kind), int(i), int(j)) for kind, i, j in rows}

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
            if batch:
                self._moved = batch[-1].result
            self._write_moved(stopping)
            for _ in range(taken):
                self._queue.task_done()

    def _write_moved(self, at_once: bool) -> None:
        """Write corrected poses, if it is time."""
        result = self._moved
        now = time.monotonic()
        if result is None or self.fault or (not at_once and now - self._poses_time < POSES_INTERVAL_S):
            return
        self._moved, self._poses_time = None, now
        try:
            self._update(result.poses, result.keyframe_ids, result.edges)
        except sqlite3.Error as error:
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            log.warning("corrected poses cannot be stored now: %s", error)
            self._moved = result

    def _write(self, batch: list[Item]) -> None:
        if not batch:
            return
        keyframes, edges = [], []
        written: dict[int, FloatArray] = {}
        count = 0
        for item in batch:
            place = {k: n for n, k in enumerate(item.result.keyframe_ids)}
            for keyframe in item.result.new_keyframes:
                T_map = item.result.poses[place[keyframe.id]]
                written[keyframe.id] = T_map
                keyframes.append(
                    (
                        self.map_id,
                        keyframe.id,
                        keyframe.stamp_ns + item.clock_offset_ns,
                        _pack_pose(keyframe.T_odom_base),
                        _pack_pose(T_map),
                        pack_points(keyframe.points),
                    )
                )
                count += 1
            edges += [_edge_row(self.map_id, edge) for edge in item.edges]
        if not keyframes and not edges:
            return
        try:
            with self._lock:
                self._connection.execute("BEGIN IMMEDIATE")
                self._connection.executemany("INSERT OR REPLACE INTO keyframes VALUES (?, ?, ?, ?, ?, ?)", keyframes)
                self._connection.executemany("INSERT INTO edges VALUES (?, ?, ?, ?, ?, ?, ?)", edges)
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
        self.written += count
        self._poses_written.update(written)
        self._weights_written.update({(e[1], e[2], e[3]): e[6] for e in edges})


def _pack_pose(T: FloatArray) -> bytes:
    return np.asarray(geometry.to_vector7(T), dtype="<f8").tobytes()


def _edge_row(map_id: int, edge: GraphEdge) -> tuple[int, str, int, int, bytes, bytes, float]:
    information = edge.information[UPPER].astype("<f4").tobytes()
    return map_id, edge.kind, edge.i, edge.j, _pack_pose(edge.T_i_j), information, edge.weight
