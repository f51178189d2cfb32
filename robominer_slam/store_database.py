"""The database of the maps: its tables, how it is opened, and how points are packed into it.

Schema and tools are sqlite-utils' (imported only when a database is made).
"""

from __future__ import annotations

import sqlite3
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SCHEMA_VERSION = 1
#: Points are stored in millimetres: finer than the whiskers can tell.
POINT_UNIT_M = 0.001


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
