"""Reads a saved map back from the store's database."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.model import SlamSection
from robominer_slam.packed_points import unpack_points
from robominer_slam.slam.keyframe import GraphEdge, Keyframe
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.store_changes import UPPER, unpack_pose
from robominer_slam.store_database import StoreError, open_to_read
from robominer_slam.store_versions import MapVersion, versions_in

FloatArray = NDArray[np.float64]


def find_map(connection: sqlite3.Connection, wanted: str, where: str) -> tuple[int, str]:
    """Id and name of a map.

    Args:
        connection: to the database.
        wanted: a map's name (the newest of that name), its id, or "" for the newest that has keyframes.
        where: names the database in messages.

    Raises:
        StoreError: there is none such, or it has no keyframes.
    """
    rows = connection.execute(
        "SELECT id, name FROM maps WHERE EXISTS (SELECT 1 FROM keyframes WHERE map_id = maps.id) ORDER BY id DESC"
    ).fetchall()
    for number, name in rows:
        if wanted == "" or name == wanted:
            return int(number), str(name)
    for number, name in rows:
        if str(number) == wanted:
            return int(number), str(name)
    known = ", ".join(f"{name!r} ({number})" if name else str(number) for number, name in rows)
    if not rows:
        raise StoreError(f"{where}: holds no map with keyframes; make one with [slam] start = 'new'")
    raise StoreError(f"{where}: no map is called {wanted!r}; there are {known}")


def load_map(path: Path, wanted: str = "", clock_offset_ns: int = 0) -> tuple[int, SavedMap]:
    """A map by name or id, or the newest; its id in the database with it.

    Args:
        path: of the database.
        wanted: see `find_map`.
        clock_offset_ns: UNIX time less the clock that stamps shall be in.

    Raises:
        StoreError: as `find_map`, or the database cannot be read.
    """
    if not path.exists():
        raise StoreError(f"[store] path = {str(path)!r}: is not there; expected a database with a saved map")
    connection = _open(path)
    try:
        map_id, name = find_map(connection, wanted, str(path))
        keyframe_rows = connection.execute(
            "SELECT id, stamp_unix_ns, T_odom_base, T_map_base, points FROM keyframes WHERE map_id = ? ORDER BY id",
            (map_id,),
        ).fetchall()
        edge_rows = connection.execute(
            "SELECT kind, i, j, T_i_j, information, weight FROM edges WHERE map_id = ? ORDER BY rowid", (map_id,)
        ).fetchall()
    except sqlite3.Error as error:
        raise StoreError(f"[store] path = {str(path)!r}: cannot be read: {error}") from error
    finally:
        connection.close()
    try:
        return map_id, _saved_map(keyframe_rows, edge_rows, name or str(map_id), clock_offset_ns)
    except (zlib.error, ValueError) as error:
        raise StoreError(f"[store] path = {str(path)!r}: a row is damaged: {error}; `run` salvages the rest") from error


def _saved_map(
    keyframe_rows: Sequence[Sequence[Any]], edge_rows: Sequence[Any], name: str, clock_offset_ns: int
) -> SavedMap:
    poses = np.array([unpack_pose(row[3]) for row in keyframe_rows])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    keyframes = tuple(
        Keyframe(int(row[0]), int(row[1]) - clock_offset_ns, unpack_pose(row[2]), unpack_points(row[4]), float(way))
        for row, way in zip(keyframe_rows, travelled, strict=True)
    )
    known = {k.id for k in keyframes}
    edges = tuple(_edge(row) for row in edge_rows if row[1] in known and row[2] in known)
    return SavedMap(keyframes, poses, edges, name)


@dataclass(frozen=True, slots=True)
class MapEntry:
    """A saved map in the list of them: number, name, time of creation (UNIX, ns), how many keyframes."""

    number: int
    name: str
    created_unix_ns: int
    keyframes: int


def maps_in(path: Path) -> list[MapEntry]:
    """Every map with keyframes, oldest first. Raises as `load_map`."""
    if not path.exists():
        raise StoreError(f"{path}: is not there; expected a database with saved maps")
    connection = _open(path)
    try:
        rows = connection.execute(
            "SELECT maps.id, name, created_unix_ns, count(*) FROM maps JOIN keyframes ON map_id = maps.id "
            "GROUP BY maps.id ORDER BY maps.id"
        ).fetchall()
    except sqlite3.Error as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error
    finally:
        connection.close()
    return [MapEntry(int(number), str(name), int(created), int(count)) for number, name, created, count in rows]


def map_versions(path: Path, wanted: str = "") -> tuple[int, str, list[MapVersion]]:
    """Id and name of a map, and its versions, oldest first. Arguments and errors as of `load_map`."""
    if not path.exists():
        raise StoreError(f"{path}: is not there; expected a database with a saved map")
    connection = _open(path)
    try:
        map_id, name = find_map(connection, wanted, str(path))
        return map_id, name, versions_in(connection, map_id)
    except sqlite3.Error as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error
    finally:
        connection.close()


def map_to_start_in(
    slam: SlamSection, path: Path, clock_offset_ns: int = 0
) -> tuple[int, SavedMap] | tuple[None, None]:
    """The map that `[slam] start` and `map` ask for; none for a new one.

    `continue` without a name begins a new map where there is none yet: a robot's first start is like any other.

    Raises:
        ConfigurationError: the method cannot start in a map.
        StoreError: there is no such map.
    """
    if slam.start == "new":
        return None, None
    if slam.method != "robust":
        raise ConfigurationError(
            f"[slam] start = {slam.start!r}: method {slam.method!r} cannot find its place in a map; "
            "expected method = 'robust' or start = 'new'"
        )
    if slam.start == "continue" and not slam.map and not has_maps(path):
        return None, None
    return load_map(path, slam.map, clock_offset_ns)


def has_maps(path: Path) -> bool:
    """Whether a database is there and holds a map with keyframes. Raises as `load_map`."""
    if not path.exists() or path.stat().st_size == 0:
        return False
    connection = _open(path)
    try:
        return connection.execute("SELECT 1 FROM keyframes LIMIT 1").fetchone() is not None
    finally:
        connection.close()


def _open(path: Path) -> sqlite3.Connection:
    try:
        return open_to_read(path)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"[store] path = {str(path)!r}: cannot be read: {error}; expected a database") from error


def _edge(row: tuple[str, int, int, bytes, bytes, float]) -> GraphEdge:
    kind, i, j, T, upper, weight = row
    information = np.zeros((6, 6))
    information[UPPER] = np.frombuffer(upper, dtype="<f4")
    information = information + np.triu(information, 1).T
    return GraphEdge(
        "loop" if kind == "loop" else "odometry", int(i), int(j), unpack_pose(T), information, float(weight)
    )
