"""Keeps the database within its bound: what is oldest and has no name goes first."""

from __future__ import annotations

import sqlite3

import numpy as np

from robominer_slam.packed_points import pack_points
from robominer_slam.store_versions import thin_versions

#: A named map keeps at least the touches of so many keyframes.
LEAST_WITH_TOUCHES = 10


def used_bytes(connection: sqlite3.Connection) -> int:
    """Bytes in use; the file does not shrink, but what is free in it is used again."""
    pages, free, size = (
        int(connection.execute(f"PRAGMA {name}").fetchone()[0])
        for name in ("page_count", "freelist_count", "page_size")
    )
    return (pages - free) * size


def thin(connection: sqlite3.Connection, current: int) -> str:
    """Make some room, within a transaction of the caller's; what was done, empty if nothing may be taken.

    The rule: the oldest map without a name is deleted. Where all have names, the oldest loses the touches of every
    second keyframe that has any, down to ten, and its versions but every tenth; its graph stays. The current map is
    never touched.
    """
    others = connection.execute("SELECT id, name FROM maps WHERE id <> ? ORDER BY id", (current,)).fetchall()
    for number, name in others:
        if not name:
            for table, column in (("versions", "map_id"), ("edges", "map_id"), ("keyframes", "map_id"), ("maps", "id")):
                connection.execute(f"DELETE FROM {table} WHERE {column} = ?", (number,))
            return f"map {number} was deleted"
    bare = pack_points(np.zeros((0, 3)))
    for number, name in others:
        rows = connection.execute(
            "SELECT id FROM keyframes WHERE map_id = ? AND length(points) > ? ORDER BY id", (number, len(bare))
        ).fetchall()
        if len(rows) > LEAST_WITH_TOUCHES:
            connection.executemany(
                "UPDATE keyframes SET points = ? WHERE map_id = ? AND id = ?",
                [(bare, number, k) for (k,) in rows[1::2]],
            )
            thin_versions(connection, number)
            return f"map {name!r} lost the touches of {len(rows) // 2} of its {len(rows)} keyframes that had any"
    return ""
