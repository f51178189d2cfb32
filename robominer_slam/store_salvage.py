"""Checks the database of the maps before the daemon uses it, and saves what is left of a broken one.

The broken file is never deleted: it is renamed, and every row that can still be read is copied into a new database.
"""

from __future__ import annotations

import logging
import sqlite3
import struct
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from robominer_slam.salvaged_rows import SalvagedRows, keyframe_fault
from robominer_slam.store_database import (
    APPLICATION_ID,
    SCHEMA_VERSION,
    TABLES,
    StoreError,
    is_full,
    make_tables,
    open_to_read,
    put_in_place,
)
from robominer_slam.store_pages import PageFile, wal_commits

log = logging.getLogger(__name__)

#: The check ends after this time, s: a robot that starts must not wait for ever.
CHECK_LIMIT_S = 30.0
#: SQLite asks for patience this often, in its own instructions.
CHECK_STEPS = 10_000
#: Where the number of frames in use, and whether it is valid, are in the index of the log (https://www.sqlite.org/walformat.html).
INDEX_FRAMES, INDEX_IS_MADE = 16, 12
#: So much of a file tells whether it is text, bytes.
TEXT_LOOKED_AT = 4096


@dataclass(frozen=True, slots=True)
class Salvage:
    """What the check found, and what was saved.

    Attributes:
        reason: what is wrong with the database; empty if nothing.
        aside: name of the broken file now.
        maps, keyframes, edges: in the new database.
        without_touches: keyframes among these whose touches were damaged.
        lost: keyframes that something that is left tells of, at least.
        bridges: edges that had to be added so that each map hangs together.
        damaged_pages: pages with rows of which some could not be read.
        postponed: why it could not be saved now; empty otherwise. The broken database is still in its place then.
    """

    reason: str = ""
    aside: str = ""
    maps: int = 0
    keyframes: int = 0
    edges: int = 0
    without_touches: int = 0
    lost: int = 0
    bridges: int = 0
    damaged_pages: int = 0
    postponed: str = ""

    def __str__(self) -> str:
        if not self.reason:
            return "sound"
        if self.postponed:
            return f"damaged ({self.reason}); not salvaged yet: {self.postponed}"
        return (
            f"damaged ({self.reason}), moved aside to {self.aside}; salvaged: {self.maps} maps, {self.keyframes} "
            f"keyframes ({self.without_touches} without their touches), {self.edges} edges and {self.bridges} in "
            f"place of lost ones; lost: at least {self.lost} keyframes, {self.damaged_pages} damaged pages"
        )


def check_and_salvage(path: Path) -> Salvage:
    """Check the database, if there is one; a broken one is moved aside and what is left of it put in its place.

    Raises:
        StoreError: a newer database, which stays as it is; or the file or its folder cannot be used.
    """
    try:
        _finish_interrupted(path)
        if _is_text(path):
            # A slip in the configuration: somebody's file must not be moved away as a broken map.
            raise StoreError(f"[store] path = {str(path)!r}: a text file; expected a database of ours, or no file yet")
        reason = find_damage(path)
        if not reason:
            return Salvage()
        log.error("%s is damaged (%s): saving what is left of it", path, reason)
        result = _salvage(path, reason)
    except OSError as error:
        raise StoreError(f"[store] path = {str(path)!r}: {error}; expected a writable folder and a database") from error
    log.error("%s: %s", path, result)
    return result


def _is_text(path: Path) -> bool:
    """Whether a file is somebody's text. A database is not, however damaged: its pages are full of zeros.

    Raises:
        OSError: it cannot be read.
    """
    if not path.exists() or path.stat().st_size == 0:
        return False
    with path.open("rb") as file:
        beginning = file.read(TEXT_LOOKED_AT)
    try:
        # A character may be cut at the end.
        beginning[:-4].decode("utf-8")
    except UnicodeDecodeError:
        return False
    return b"\0" not in beginning


def find_damage(path: Path) -> str:
    """What is wrong with a database; empty if nothing, or if there is none.

    Raises:
        StoreError: it is newer than this program, in use, or cannot be opened.
        OSError: it cannot be read.
    """
    wal = Path(f"{path}-wal")
    if not path.exists() or path.stat().st_size == 0:
        return "the file is empty, its log is not" if wal.exists() and wal.stat().st_size else ""
    commits = wal_commits(wal)
    try:
        if _number_is_damaged(path):
            return "the header's schema version is damaged"
        with closing(open_to_read(path)) as connection:
            return _ask(connection, path, commits)
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM, sqlite3.SQLITE_READONLY):
            raise StoreError(f"[store] path = {str(path)!r}: {error}; expected a database that can be read") from error
        return str(error)


def _number_is_damaged(path: Path) -> bool:
    """Whether the schema version in the header contradicts its copy, or is none that any program would write."""
    with path.open("rb") as file:
        header = file.read(100)
    if len(header) < 100:
        return True
    version, copy = struct.unpack(">I", header[60:64])[0], struct.unpack(">I", header[68:72])[0]
    return bool(version == 0 or (version != copy - APPLICATION_ID and 1 <= copy - APPLICATION_ID <= SCHEMA_VERSION))


def _ask(connection: sqlite3.Connection, path: Path, commits: int) -> str:
    end = time.monotonic() + CHECK_LIMIT_S
    connection.set_progress_handler(lambda: time.monotonic() > end, CHECK_STEPS)
    try:
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        missing = {name for since, names in TABLES.items() if since <= version for name in names} - tables
        if missing:
            return f"tables are missing: {', '.join(sorted(missing))}"
        used = _frames_in_use(connection, path)
        if used is not None and used < commits:
            return f"{commits - used} of {commits} pages of the write-ahead log cannot be used"
        answer = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
        if answer != "ok":
            return " ".join(str(answer).split())
        for row in connection.execute("SELECT map_id, id, T_odom_base, T_map_base, points FROM keyframes"):
            fault = keyframe_fault(*row[2:])
            if fault:
                return f"keyframe {row[1]} of map {row[0]}: {fault}"
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_INTERRUPT:
            raise
        log.warning("%s: only a part was checked in %.0f s", path, CHECK_LIMIT_S)
    return ""


def _frames_in_use(connection: sqlite3.Connection, path: Path) -> int | None:
    """How many frames of the log SQLite believes; None where there is no index that tells."""
    index = Path(f"{path}-shm")
    in_memory = connection.execute("PRAGMA database_list").fetchone()[2] == ""
    if in_memory or not index.exists():
        return None
    with index.open("rb") as file:
        head = file.read(INDEX_FRAMES + 4)
    if len(head) < INDEX_FRAMES + 4 or not head[INDEX_IS_MADE]:
        return None  # there was no room for it
    return int(struct.unpack_from("=I", head, INDEX_FRAMES)[0])


def _salvage(path: Path, reason: str) -> Salvage:
    pages = PageFile(path, Path(f"{path}-wal"))
    rows = SalvagedRows()
    for row in pages.rows():
        rows.take(row)
    rows.bridge()
    begun, done = path.with_name(f"{path.name}.new"), path.with_name(f"{path.name}.salvaged")
    result = Salvage(
        reason, "", len(rows.maps), len(rows.keyframes), len(rows.edges), rows.without_touches, rows.lost,
        rows.bridges, pages.damaged,
    )  # fmt: skip
    for file in _with_companions(begun):
        file.unlink(missing_ok=True)
    try:
        make_tables(begun)
        with closing(sqlite3.connect(begun, isolation_level=None)) as connection:
            connection.execute("BEGIN")
            rows.write(connection)
            connection.execute("COMMIT")
        put_in_place(begun, done)
        aside = _move_aside(path)
    except (OSError, sqlite3.Error) as error:
        for file in _with_companions(begun):
            file.unlink(missing_ok=True)
        if is_full(error):
            return replace(result, postponed=str(error))
        raise StoreError(f"[store] path = {str(path)!r}: damaged, and cannot be salvaged: {error}") from error
    put_in_place(done, path)
    return replace(result, aside=aside.name)


def _finish_interrupted(path: Path) -> None:
    """What was saved takes its place where the power went away in between; without the broken file, it is complete."""
    done = path.with_name(f"{path.name}.salvaged")
    if not done.exists():
        return
    if path.exists():
        done.unlink()  # the broken file was not moved yet: it is salvaged again
    else:
        for file in _with_companions(path):
            if file.exists():
                file.replace(_free_name(file))
        put_in_place(done, path)


def _move_aside(path: Path) -> Path:
    """Rename the database and what belongs to it; returns its new name."""
    aside = _free_name(path)
    # The database last: as long as it is there, an interrupted start begins anew.
    for old, new in reversed(list(zip(_with_companions(path), _with_companions(aside), strict=True))):
        if old.exists():
            old.replace(new)
    return aside


def _free_name(path: Path) -> Path:
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    name = f"{path.name}.broken-{stamp}"
    return next(p for p in _numbered(path.with_name(name)) if not p.exists())


def _numbered(path: Path) -> Iterator[Path]:
    yield path
    for n in range(2, 10_000):
        yield path.with_name(f"{path.name}-{n}")


def _with_companions(path: Path) -> tuple[Path, ...]:
    """The database, its log and the log's index."""
    return path, Path(f"{path}-wal"), Path(f"{path}-shm")
