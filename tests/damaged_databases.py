"""Databases as a killed daemon leaves them, damaged in every way that cards and power cuts know."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robominer_slam import geometry
from robominer_slam.configuration.model import Configuration, SlamSection
from robominer_slam.service import map_to_start_with
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe
from robominer_slam.store import MapStore
from robominer_slam.store_reader import load_map
from robominer_slam.store_salvage import Salvage, check_and_salvage

KEYFRAMES = 100
ENDS = ("", "-wal", "-shm")


def keyframe_result(k: int, seed: int = 0) -> BackendResult:
    """What the back-end says of keyframe k of a drive along x; touches as many and as wide as a robot's."""
    rng = np.random.default_rng((seed, k))
    poses = np.array([geometry.pose_matrix([0.25 * i, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]) for i in range(k + 1)])
    step = geometry.pose_matrix([0.25, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    added = [GraphEdge("odometry", k - 1, k, step, np.eye(6), 1.0)] if k else []
    if k >= 20 and k % 5 == 0:
        back = geometry.pose_matrix([-5.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        added.append(GraphEdge("loop", k, k - 20, back, np.eye(6), 0.9))
    points = rng.uniform((-0.3, -0.25, -0.22), (0.3, 0.25, -0.18), (300, 3))
    keyframe = Keyframe(k, 1_000_000_000 + k, poses[k], points, 0.25 * k)
    return BackendResult(keyframe, np.eye(4), poses, np.eye(3) * 1e-4, added, len(added), k + 1, added=added)


def make_original(folder: Path) -> Path:
    """A database whose first half is in its file and the rest in its log, as after SIGKILL."""
    path, copy = folder / "made" / "map.db", folder / "original" / "map.db"
    copy.parent.mkdir(parents=True)
    with MapStore(path, 0.1, "rm3", "gallery") as store:
        for k in range(KEYFRAMES):
            store.add(keyframe_result(k), 0)
            if k % 10 == 9:
                assert store.flush(10.0)
            if k == KEYFRAMES // 2:
                with closing(sqlite3.connect(path)) as connection:
                    connection.execute("PRAGMA wal_checkpoint(RESTART)")
        assert store.flush(10.0)
        for end in ENDS:
            shutil.copy(f"{path}{end}", f"{copy}{end}")
    return copy


def _edit(path: Path, change: Callable[[bytearray], None]) -> None:
    data = bytearray(path.read_bytes())
    change(data)
    path.write_bytes(bytes(data))


def _flip(data: bytearray, rng: np.random.Generator, count: int, end: int | None = None) -> None:
    for place in rng.integers(0, end or len(data), count).tolist():
        data[place] ^= 1 << int(rng.integers(8))


def _fill(data: bytearray, rng: np.random.Generator, noise: bool) -> None:
    for _ in range(int(rng.integers(1, 6))):
        size = 512 << int(rng.integers(0, 5))
        place = int(rng.integers(0, len(data) // 512)) * 512
        size = min(size, len(data) - place)
        data[place : place + size] = rng.bytes(size) if noise else bytes(size)


def _truncate(path: Path, rng: np.random.Generator) -> None:
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.truncate(int(rng.integers(0, size)))


def _wal(path: Path) -> Path:
    return Path(f"{path}-wal")


def _replace(path: Path, data: bytes) -> None:
    _wal(path).unlink()
    path.write_bytes(data)


#: What is done to a database, by name.
KINDS: dict[str, Callable[[Path, np.random.Generator], object]] = {
    "truncated": _truncate,
    "bits flipped": lambda path, rng: _edit(path, lambda d: _flip(d, rng, int(rng.integers(1, 65)))),
    "blocks zeroed": lambda path, rng: _edit(path, lambda d: _fill(d, rng, False)),
    "blocks of noise": lambda path, rng: _edit(path, lambda d: _fill(d, rng, True)),
    "header damaged": lambda path, rng: _edit(path, lambda d: _flip(d, rng, int(rng.integers(1, 30)), 100)),
    "log cut": lambda path, rng: _truncate(_wal(path), rng),
    "log removed": lambda path, _: _wal(path).unlink(),
    "log's bits flipped": lambda path, rng: _edit(_wal(path), lambda d: _flip(d, rng, int(rng.integers(1, 17)))),
    "log's header damaged": lambda path, rng: _edit(_wal(path), lambda d: _flip(d, rng, 3, 32)),
    "database emptied": lambda path, _: path.write_bytes(b""),
    "database removed": lambda path, _: path.unlink(),
    "no database": lambda path, rng: _replace(path, rng.bytes(20_000)),
}


@dataclass(frozen=True, slots=True)
class Start:
    """How a start went.

    Attributes:
        salvage: what the check found.
        keyframes: of the original that are in the database after the start.
        known: keyframes that the daemon began with.
    """

    salvage: Salvage
    keyframes: int
    known: int


def damage(original: Path, folder: Path, kind: str, seed: int) -> Path:
    """A copy of the original in a folder of its own, damaged."""
    folder.mkdir(parents=True)
    for end in ENDS:
        shutil.copy(f"{original}{end}", folder / f"map.db{end}")
    rng = np.random.default_rng(seed)
    path = folder / "map.db"
    if rng.integers(2):
        Path(f"{path}-shm").unlink()  # as after a power cut
    KINDS[kind](path, rng)
    return path


def start(path: Path) -> Start:
    """Start as the daemon does, with `[slam] start = "continue"`, store one keyframe, and read everything back.

    Raises:
        AssertionError: the new keyframe is not stored.
    """
    configuration = Configuration(slam=SlamSection(method="robust", start="continue"))
    salvage = check_and_salvage(path)
    map_id, known = map_to_start_with(configuration, path, salvage)
    with MapStore(path, 0.1, "rm3", "", map_id, salvage=salvage) as store:
        new = KEYFRAMES + 1000
        store.add(keyframe_result(new), 0)
        assert store.flush(10.0), store.fault
        _, after = load_map(path, str(store.map_id) if known is None else "")
    assert new in after.ids
    assert check_and_salvage(path).reason == "", "what was salvaged is sound"
    return Start(salvage, sum(k < KEYFRAMES for k in after.ids), 0 if known is None else len(known.keyframes))
