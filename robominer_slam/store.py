"""Keyframes kept in SQLite: one writer thread, batched commits, WAL with full sync.

What the back-end takes out of the graph is taken out here too, with its edges; the edges that bridge it are added.

The rows of a drive are written with plain SQL, since sqlite-utils costs 5 ms a row. A
batch is on the disk at most `sync_s` after its oldest keyframe.
Poses that the back-end has moved since are written every few seconds, the weights of edges with them: a process
that is killed loses no more than that.
"""

from __future__ import annotations

import logging
import queue
import sqlite3
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe, Merge
from robominer_slam.store_database import open_database, pack_points, unpack_points

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]
#: Kind, i, j: an edge's name in its map.
EdgeKey = tuple[str, int, int]

QUEUE_LENGTH = 256
UPPER = np.triu_indices(6)
#: From one writing of corrected poses to the next, s: each costs a page per few keyframes.
POSES_INTERVAL_S = 4.0
#: Poses that moved less than this since they were written are not written again, m or (of the rotation) 1.
POSE_TOLERANCE = 0.001


@dataclass(frozen=True, slots=True)
class _Change:
    """What a result changes in the store; without the poses of the whole map, since many may wait for the disk.

    Attributes:
        keyframes: new ones, with their poses in map.
        edges: new ones.
        removed, merged, bare: as in `BackendResult`.
        clock_offset_ns: added to stamps.
    """

    keyframes: Sequence[tuple[Keyframe, FloatArray]]
    edges: Sequence[GraphEdge]
    removed: Sequence[int]
    merged: Sequence[Merge]
    bare: Sequence[int]
    clock_offset_ns: int

    @classmethod
    def of(cls, result: BackendResult, edges: Sequence[GraphEdge], clock_offset_ns: int) -> _Change:
        place = {k: n for n, k in enumerate(result.keyframe_ids)} if result.new_keyframes else {}
        keyframes = [(k, result.poses[place[k.id]].copy()) for k in result.new_keyframes]
        return cls(keyframes, edges, result.removed, result.merged, result.bare, clock_offset_ns)

    def without_keyframes(self) -> _Change:
        """What is left of it when its keyframes are lost."""
        return replace(self, keyframes=())


class MapStore:
    """The thread `store`. Use as a context manager.

    Attributes:
        folder: where the database lies.
        written: keyframes on the disk.
        fault: why nothing is being written now; empty if all is well.
        dropped: keyframes that could not be written because the disk has been failing for long.
        sync_s: a keyframe is on the disk at most this long after it was made.
        frozen: whether the map must stay as it is: nothing is written then.
    """

    def __init__(
        self, path: Path, sync_s: float, robot: str, name: str, map_id: int | None = None, frozen: bool = False
    ) -> None:
        """Open the database; keyframes go into a new map, or are added to that of `map_id`, which may be frozen."""
        self.folder = path.parent
        self._connection = open_database(path)
        self._lock = threading.Lock()
        self.sync_s = sync_s
        self._queue: queue.Queue[list[_Change] | None] = queue.Queue(QUEUE_LENGTH)
        self._late: list[_Change] = []
        self.map_id = self._start_map(robot, name) if map_id is None else map_id
        self._edges_seen = self._stored_edges() if map_id is not None else set()
        self._latest: BackendResult | None = None
        self._moved: BackendResult | None = None
        self._poses_written: dict[int, FloatArray] = {}
        self._weights_written: dict[EdgeKey, float] = {}
        self._poses_time = time.monotonic()
        self.frozen = frozen
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
        """Keep a result's new keyframes and edges, in time its poses, and drop what left the graph; never waits."""
        if self.frozen:
            return
        edges = result.added
        if edges is None:
            edges = [e for e in result.edges if (e.kind, e.i, e.j) not in self._edges_seen]
        self._edges_seen.update((e.kind, e.i, e.j) for e in edges)
        if result.removed:
            gone = set(result.removed)
            self._edges_seen = {key for key in self._edges_seen if key[1] not in gone and key[2] not in gone}
        change = _Change.of(result, edges, clock_offset_ns)
        self._latest = result
        try:
            self._queue.put_nowait([*self._late, change])
            self._late = []
        except queue.Full:
            self.dropped += len(result.new_keyframes)
            self._late.append(change.without_keyframes())

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
        weights: dict[EdgeKey, float] = {}
        for e in edges:
            # Merged keyframes may leave two closures of one name: none counts if one was taken back.
            weights[e.kind, e.i, e.j] = min(e.weight, weights.get((e.kind, e.i, e.j), 1.0))
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
        self.flush(self.sync_s * 2)
        with self._lock:
            self.map_id = self._start_map(robot, name)
        self.frozen = False
        self._edges_seen = set()
        self._late = []
        self._latest = self._moved = None
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
            batch = [] if item is None else list(item)
            stopping = item is None
            taken = 1
            # Half the time that a keyframe may wait is for collecting, the rest for a slow card.
            end = time.monotonic() + self.sync_s / 2
            while not stopping and (left := end - time.monotonic()) > 0:
                try:
                    item = self._queue.get(timeout=left)
                except queue.Empty:
                    break
                taken += 1
                if item is None:
                    stopping = True
                else:
                    batch += item
            self._write(self._failed + batch)
            if batch:
                self._moved = self._latest
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
            self.dropped += sum(len(change.keyframes) for change in batch[:-QUEUE_LENGTH])
            self._failed = batch[-QUEUE_LENGTH:]
            return
        self._failed = []
        self.fault = ""
        self.written += sum(len(change.keyframes) for change in batch)
        for change in batch:
            self._poses_written.update({keyframe.id: T for keyframe, T in change.keyframes})
            self._weights_written.update({(e.kind, e.i, e.j): e.weight for e in change.edges})
        gone = {key for change in batch for key in change.removed}
        if gone:
            self._poses_written = {k: T for k, T in self._poses_written.items() if k not in gone}
            self._weights_written = {
                key: w for key, w in self._weights_written.items() if key[1] not in gone and key[2] not in gone
            }

    def _apply(self, change: _Change) -> None:
        many, map_id = self._connection.executemany, self.map_id
        rows = [
            (
                map_id,
                keyframe.id,
                keyframe.stamp_ns + change.clock_offset_ns,
                _pack_pose(keyframe.T_odom_base),
                _pack_pose(T_map_base),
                pack_points(keyframe.points),
            )
            for keyframe, T_map_base in change.keyframes
        ]
        many("INSERT OR REPLACE INTO keyframes VALUES (?, ?, ?, ?, ?, ?)", rows)
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
