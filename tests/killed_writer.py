"""A process that stores keyframes and tells which, and is killed at a random moment, again and again."""

from __future__ import annotations

import multiprocessing
import threading
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from robominer_slam.configuration.model import Configuration, SlamSection
from robominer_slam.service import map_to_start_with
from robominer_slam.store import MapStore
from robominer_slam.store_reader import has_maps, load_map
from robominer_slam.store_salvage import check_and_salvage
from tests.damaged_databases import keyframe_result

#: Nobody waits longer for a start, s.
START_LIMIT_S = 30.0


def write(path: Path, sync_s: float, interval_s: float, first: int, tell: Connection) -> None:
    """Start as the daemon does, go on with the newest map and store keyframes until killed.

    Tells "begin", then "ready" or what it found, then id and monotonic time of each keyframe.
    """
    tell.send("begin")
    configuration = Configuration(slam=SlamSection(method="robust", start="continue"))
    salvage = check_and_salvage(path)
    map_id, _ = map_to_start_with(configuration, path, salvage)
    with MapStore(path, sync_s, "rm3", "", map_id, salvage=salvage) as store:
        tell.send(salvage.reason or "ready")
        pace, k = threading.Event(), first
        while True:
            result = keyframe_result(k)
            made = time.monotonic()
            store.add(result, 0)
            tell.send((k, made))
            k += 1
            pace.wait(interval_s)


@dataclass(frozen=True, slots=True)
class Kill:
    """What a kill did.

    Attributes:
        started: whether the process had opened its database; it is killed in its first moments now and then.
        made: keyframes it made.
        lost: how many of these are not there.
        lost_age_s: of the oldest one that is not there, when the process was killed; 0 if all are.
        lost_before: keyframes that were there before and are no more: none may be.
        damage: what a start after it found wrong; empty if nothing.
    """

    started: bool
    made: int
    lost: int
    lost_age_s: float
    lost_before: int
    damage: str


class KilledWriter:
    """Kills writers of one database, one after the other."""

    def __init__(self, path: Path, sync_s: float, interval_s: float, seed: int) -> None:
        self._path, self._sync_s, self._interval_s = path, sync_s, interval_s
        self._rng = np.random.default_rng(seed)
        self._there: set[int] = set()
        self._next = 0
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["tests.killed_writer"])

    def kill(self) -> Kill:
        """Start a writer, kill it and look."""
        # One of five is killed while it opens or makes its database, or recovers the log of the one before.
        wait_s = self._rng.uniform(0.0, 0.06) if self._rng.random() < 0.2 else self._rng.uniform(0, 2 * self._sync_s)
        ours, theirs = self._context.Pipe(duplex=False)
        process = self._context.Process(
            target=write, args=(self._path, self._sync_s, self._interval_s, self._next, theirs)
        )
        process.start()
        theirs.close()
        assert ours.poll(START_LIMIT_S), "the process did not come up"
        ours.recv()
        heard: list[object] = []
        end = time.monotonic() + float(wait_s)
        while (left := end - time.monotonic()) > 0 and ours.poll(left):
            heard.append(ours.recv())  # EOFError, and so a failure, if it ended by itself
        killed = time.monotonic()
        process.kill()
        process.join()
        try:
            while True:
                heard.append(ours.recv())
        except (EOFError, OSError):
            ours.close()  # that was the last whole message
        return self._look(heard, killed)

    def _look(self, heard: list[object], killed: float) -> Kill:
        words = [h for h in heard if isinstance(h, str)]
        made = dict(h for h in heard if isinstance(h, tuple))
        damage = check_and_salvage(self._path).reason or "".join(w for w in words if w != "ready")
        there = set(load_map(self._path)[1].ids) if has_maps(self._path) else set()
        lost = made.keys() - there
        age = max((killed - made[k] for k in lost), default=0.0)
        before = len(self._there - there)
        self._there = there
        self._next = max([self._next, *(k + 1 for k in made), *(k + 1 for k in there)])
        return Kill(bool(words), len(made), len(lost), age, before, damage)
