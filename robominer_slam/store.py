"""Keyframes kept in SQLite: one writer thread, batched commits, WAL with full sync.

What the back-end takes out of the graph is taken out here too, with its edges; the edges that bridge it are added.
Rows are written with plain SQL, since sqlite-utils costs 5 ms a row. A batch is on the disk at most `sync_s` after its
oldest keyframe. Poses that the back-end has moved since are written every few seconds, the weights of edges with them.
"""

from __future__ import annotations

import logging
import queue
import sqlite3
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.keyframe import BackendResult, GraphEdge
from robominer_slam.store_changes import Change, MapRow
from robominer_slam.store_corrections import POSE_TOLERANCE, SAVED_TOLERANCE, Corrections, edge_keys
from robominer_slam.store_database import StoreError, StoreFullError, is_full, open_database, transaction
from robominer_slam.store_salvage import Salvage, check_and_salvage
from robominer_slam.store_size import thin, used_bytes

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

QUEUE_LENGTH = 256
#: What failed is tried again at least this often, s: there may be room again while the robot stands still.
RETRY_S = 2.0
#: From one writing of corrected poses to the next, s: each costs a page per few keyframes.
POSES_INTERVAL_S = 4.0


class MapStore:
    """The thread `store`. Use as a context manager.

    Attributes:
        folder: where the database lies.
        written: keyframes on the disk.
        fault: why nothing is being written now; empty if all is well.
        dropped: keyframes that could not be written because the disk has been failing for long.
        sync_s: a keyframe is on the disk at most this long after it was made.
        frozen: whether the map must stay as it is: nothing is written then.
        salvage: what the check at the start found.
        too_large: whether the current map alone is larger than the database may be; it is stored all the same.
    """

    def __init__(
        self, path: Path, sync_s: float, robot: str, name: str, map_id: int | None = None, frozen: bool = False,
        salvage: Salvage | None = None,
        point_voxel: float = 0.0,
        max_mb: float = 1000.0,
    ) -> None:  # fmt: skip
        """Open the database; keyframes go into a new map, or are added to that of `map_id`, which may be frozen.

        On a full disk it is opened later, when there is room.

        Raises:
            StoreError: it cannot be opened for another reason.
        """
        self.folder = path.parent
        self.salvage = salvage or Salvage()
        self.written = 0
        self.dropped = 0
        self.fault = ""
        self.too_large = False
        self.frozen = frozen
        self._max_bytes = max_mb * 1e6
        self.path = path
        self._lock = threading.Lock()
        self.sync_s = sync_s
        self._queue: queue.Queue[list[Change] | None] = queue.Queue(QUEUE_LENGTH)
        self._late: list[Change] = []
        self._row = MapRow(robot, name, map_id, point_voxel, str(self.salvage))
        self._connection: sqlite3.Connection | None = None
        self._open_at_start()
        self._edges_seen = edge_keys(path, map_id) if map_id is not None else set()
        self._latest: BackendResult | None = None
        self._moved: BackendResult | None = None
        self._corrections = Corrections(self._edges_seen)
        self._poses_time = time.monotonic()
        self._failed: list[Change] = []
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)

    def _open_at_start(self) -> None:
        try:
            connection = self._opened()
            if not self.frozen:
                self._row.ensure(connection)
        except (StoreFullError, sqlite3.Error) as error:
            if isinstance(error, sqlite3.Error) and not is_full(error):
                raise StoreError(f"[store] path = {str(self.path)!r}: {error}") from error
            self._failing(error)

    def _opened(self) -> sqlite3.Connection:
        """The database, opened now if there was no room for it before. Raises as `open_database`."""
        if self._connection is None:
            if self.salvage.postponed:
                self.salvage = check_and_salvage(self.path)
            if self.salvage.postponed:
                raise StoreFullError(f"no room to salvage the damaged {self.path.name}: {self.salvage.postponed}")
            self._connection = open_database(self.path)
        return self._connection

    def _failing(self, error: Exception) -> None:
        if not self.fault:
            log.error("the map cannot be stored: %s; mapping goes on in memory", error)
        self.fault = str(error)

    @property
    def map_id(self) -> int:
        """Of the current map; 0 while there was no room to begin it."""
        return self._row.id or 0

    def __enter__(self) -> MapStore:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.put(None)
        self._thread.join()
        if self._connection is not None:
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
        change = Change.of(self._row, result, edges, clock_offset_ns)
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

        Raises:
            StoreError: the disk does not take them.
        """
        if self.frozen:
            return
        self._moved = None
        try:
            self._update(poses, range(len(poses)) if ids is None else ids, edges, SAVED_TOLERANCE)
        except sqlite3.Error as error:
            raise StoreError(f"corrected poses cannot be stored now: {error}") from error

    def _update(self, poses: FloatArray, ids: Iterable[int], edges: Sequence[GraphEdge], tolerance: float) -> None:
        with self._lock:
            with transaction(self._opened()) as connection:
                self._corrections.write(connection, self.map_id, poses, ids, edges, tolerance)
            self._corrections.written()

    def rename(self, name: str) -> None:
        """Name the current map. Raises StoreError where the disk does not take it."""
        self._row.name = name
        try:
            with self._lock:
                self._opened().execute("UPDATE maps SET name = ? WHERE id = ?", (name, self._row.id))
        except sqlite3.Error as error:
            raise StoreError(f"the name cannot be stored now: {error}") from error

    def new_map(self, robot: str, name: str) -> None:
        """What is added from now on belongs to a new map."""
        self.flush(self.sync_s * 2)
        self._row = replace(self._row, robot=robot, name=name, id=None, logged=False)
        try:
            with self._lock:
                self._row.ensure(self._opened())
        except (StoreError, sqlite3.Error) as error:
            self._failing(error)  # the row is made with the first keyframe that the disk takes
        self.frozen = False
        self._edges_seen = set()
        self._late = []
        self._latest = self._moved = None
        self._corrections = Corrections()

    @property
    def waiting(self) -> int:
        """Results that have not been written yet; beyond QUEUE_LENGTH they are dropped."""
        return self._queue.qsize()

    @property
    def unwritten(self) -> int:
        """Keyframes that the disk has refused so far, and that are tried again."""
        return sum(len(change.keyframes) for change in self._failed)

    def flush(self, timeout_s: float) -> bool:
        """Wait until what was added so far is on the disk; False if it took longer or the disk does not take it."""
        end = time.monotonic() + timeout_s
        while self._queue.unfinished_tasks:
            if time.monotonic() > end:
                return False
            time.sleep(0.01)
        return not self.fault

    def _run(self) -> None:
        stopping = False
        while not stopping:
            try:
                item = self._queue.get(timeout=RETRY_S if self.fault else None)
            except queue.Empty:
                self._write(self._failed)
                continue
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
            tolerance = SAVED_TOLERANCE if at_once else POSE_TOLERANCE
            self._update(result.poses, result.keyframe_ids, result.edges, tolerance)
        except (StoreError, sqlite3.Error) as error:
            log.warning("corrected poses cannot be stored now: %s", error)
            self._moved = result

    def _write(self, batch: list[Change]) -> None:
        if not batch and not self.fault:
            return
        before = [(change.row, change.row.id, change.row.logged) for change in batch]
        try:
            with self._lock:
                with transaction(self._opened()) as connection:
                    for change in batch:
                        change.apply(connection)
                self._corrections.take(change for change in batch if change.row is self._row)
        except (StoreError, sqlite3.Error) as error:
            # The robot goes on mapping in memory; the batch is tried again with the next one.
            for row, identity, logged in before:
                row.id, row.logged = identity, logged  # rolled back with the rest
            self._failing(error)
            self.dropped += sum(len(change.keyframes) for change in batch[:-QUEUE_LENGTH])
            self._failed = batch[-QUEUE_LENGTH:]
            return
        if self.fault:
            log.warning("the map is stored again")
        self._failed, self.fault = [], ""
        self.written += sum(len(change.keyframes) for change in batch)
        self._keep_small()

    def _keep_small(self) -> None:
        """Thin the oldest sessions while the database is larger than it may be."""
        connection = self._opened()
        try:
            while used_bytes(connection) > self._max_bytes:
                with self._lock, transaction(connection):
                    done = thin(connection, self.map_id)
                self.too_large = not done
                if not done:
                    return
                log.warning("the database is larger than [store] max_mb: %s", done)
            self.too_large = False
        except sqlite3.Error as error:
            log.warning("the database cannot be thinned now: %s", error)
