"""Versions of a saved map: whenever corrected poses are written, the map on the disk becomes another one.

A row is written in the transaction of the poses it speaks of. Its id holds the map's and its own number, so that rows
lie by map and number without an index, which would cost as many pages again.
"""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass

#: A map has fewer versions than this; its versions have ids from its own times this on.
NUMBERS = 1 << 32
#: The newest ones of a map are all kept, of older ones every tenth: one more each 40 s of corrections, 50 bytes.
NEWEST_KEPT = 500
OLDER_STEP = 10


@dataclass(frozen=True, slots=True)
class MapVersion:
    """What a map became when corrected poses were written.

    Attributes:
        number: from 1 on in each map; of older versions every tenth is left.
        written_unix_ns: when, ns since 1970.
        keyframes, loop_closures: in the map then. Closures of the same two keyframes count as one.
        moved: stored keyframes whose poses were written.
        moved_m: the farthest that one of these moved since it was written before, m.
    """

    number: int
    written_unix_ns: int
    keyframes: int
    loop_closures: int
    moved: int
    moved_m: float


def add_version(connection: sqlite3.Connection, map_id: int, loop_closures: int, moved: int, moved_m: float) -> None:
    """Write the next version of a map, within the transaction that writes the poses; for values see `MapVersion`."""
    first = map_id * NUMBERS
    newest = connection.execute("SELECT max(id) FROM versions WHERE id BETWEEN ? AND ?", (first, first + NUMBERS - 1))
    number = (newest.fetchone()[0] or first) - first + 1
    keyframes = connection.execute("SELECT count(*) FROM keyframes WHERE map_id = ?", (map_id,)).fetchone()[0]
    connection.execute(
        "INSERT INTO versions VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
        (first + number, map_id, number, time.time_ns(), keyframes, loop_closures, moved, moved_m),
    )
    if number % OLDER_STEP == 0 and number > NEWEST_KEPT:
        # Ten at a time: rows of one page or two, instead of another page with every version.
        tenth = first + number - NEWEST_KEPT
        connection.execute("DELETE FROM versions WHERE id > ? AND id < ?", (tenth - OLDER_STEP, tenth))


def thin_versions(connection: sqlite3.Connection, map_id: int) -> None:
    """Keep every tenth version of a map, and its newest one."""
    connection.execute(
        "DELETE FROM versions WHERE map_id = ?1 AND number % ?2 <> 0 "
        "AND number < (SELECT max(number) FROM versions WHERE map_id = ?1)",
        (map_id, OLDER_STEP),
    )


def versions_in(connection: sqlite3.Connection, map_id: int) -> list[MapVersion]:
    """Versions of a map, oldest first; none where the database is from before there were any."""
    if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'versions'").fetchone() is None:
        return []
    rows = connection.execute(
        "SELECT number, written_unix_ns, keyframes, loop_closures, moved, moved_m FROM versions "
        "WHERE map_id = ? ORDER BY number",
        (map_id,),
    )
    return [MapVersion(*row) for row in rows]
