"""The database of the maps: its tables, how older ones are brought up to date, and how it is opened.

Schema and tools are sqlite-utils' (imported only when a database is made).
"""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from robominer_slam.store_pages import PAGE_SIZE, merged

#: 2: touches are sorted and thinned (`packed_points`), and there is a log of sessions. 3: versions of maps.
SCHEMA_VERSION = 3
#: The log is taken into the database after so many pages: 2 MB.
LOG_PAGES = 4000
#: In the header of our databases, plus the schema version: where both differ, the header is damaged, not newer.
APPLICATION_ID = 0x524D5300
#: SQLite knows only one kind of full disk; these come of quotas, limits, and where its index of the log has no room.
REFUSED_WRITES = (
    sqlite3.SQLITE_IOERR_WRITE,
    sqlite3.SQLITE_IOERR_FSYNC,
    sqlite3.SQLITE_IOERR_TRUNCATE,
    sqlite3.SQLITE_IOERR_SHMSIZE,
)
SESSIONS = (
    "CREATE TABLE sessions (id INTEGER PRIMARY KEY, map_id INTEGER, started_unix_ns INTEGER, program TEXT, found TEXT)"
)
VERSIONS = (
    "CREATE TABLE versions (id INTEGER PRIMARY KEY, map_id INTEGER, number INTEGER, written_unix_ns INTEGER, "
    "keyframes INTEGER, loop_closures INTEGER, moved INTEGER, moved_m REAL)"
)
#: Tables by the schema version that brought them.
TABLES: dict[int, tuple[str, ...]] = {1: ("maps", "keyframes", "edges"), 2: ("sessions",), 3: ("versions",)}


def _numbers(version: int) -> tuple[str, str]:
    return f"PRAGMA application_id = {APPLICATION_ID + version}", f"PRAGMA user_version = {version}"


#: What brings a database from a version to the next one.
MIGRATIONS: dict[int, tuple[str, ...]] = {1: (SESSIONS, *_numbers(2)), 2: (VERSIONS, *_numbers(3))}


class StoreError(ValueError):
    """A database that cannot be used; one line that says what, where and what to do."""


class StoreFullError(StoreError):
    """The disk has no room for the database now; the robot maps in memory until it has."""


def create_schema(path: Path) -> None:
    """Make the tables of a new database under another name first: one that was begun only is never found."""
    begun = path.with_name(f"{path.name}.new")
    for end in ("", "-wal", "-shm", "-journal"):
        Path(f"{begun}{end}").unlink(missing_ok=True)
    make_tables(begun)
    put_in_place(begun, path)


def put_in_place(begun: Path, path: Path) -> None:
    """Give a finished database its name, so that it has it after a power cut too."""
    begun.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def make_tables(path: Path) -> None:
    """Make the tables in a new file."""
    import sqlite_utils  # 25 MB and 0.2 s: only for a database that does not exist yet

    database = sqlite_utils.Database(str(path))
    try:
        database.execute(f"PRAGMA page_size = {PAGE_SIZE}")
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
        for statement in (SESSIONS, VERSIONS, *_numbers(SCHEMA_VERSION)):
            database.execute(statement)
    finally:
        database.close()


def open_database(path: Path) -> sqlite3.Connection:
    """Open or make the database of the maps.

    Raises:
        StoreFullError: the disk is full.
        StoreError: the folder cannot be written, the file is no database or is newer than this program.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.stat().st_size == 0:
            create_schema(path)
        connection = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
        version = refuse_newer(connection, path)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute(f"PRAGMA wal_autocheckpoint = {LOG_PAGES}")
        _migrate(connection, version)
    except (OSError, sqlite3.Error) as error:
        if is_full(error):
            raise StoreFullError(f"[store] path = {str(path)!r}: {error}") from error
        raise StoreError(f"[store] path = {str(path)!r}: {error}; expected a writable folder and a database") from error
    return connection


def open_to_read(path: Path) -> sqlite3.Connection:
    """Open a database that is there, without changing it; also on a disk that is full.

    Raises:
        sqlite3.Error, OSError: it cannot be read.
        StoreError: it is newer than this program.
    """
    address = path.resolve().as_uri()
    connection = sqlite3.connect(f"{address}?mode=ro", uri=True, isolation_level=None)
    try:
        connection.execute("SELECT 1 FROM sqlite_master").fetchone()
    except sqlite3.Error as error:
        connection.close()
        if error.sqlite_errorcode & 0xFF not in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL, sqlite3.SQLITE_CANTOPEN):
            raise
        # There is no room for the index of the log: without a log none is needed, otherwise both are put together in
        # memory.
        wal = Path(f"{path}-wal")
        if wal.exists() and wal.stat().st_size > 0:
            connection = sqlite3.connect(":memory:", isolation_level=None)
            connection.deserialize(merged(path, wal))
        else:
            connection = sqlite3.connect(f"{address}?immutable=1", uri=True, isolation_level=None)
    refuse_newer(connection, path)
    return connection


def refuse_newer(connection: sqlite3.Connection, path: Path) -> int:
    """The schema's version. Raises StoreError where this program does not know it; nothing is changed then."""
    version = int(connection.execute("PRAGMA user_version").fetchone()[0])
    if not 1 <= version <= SCHEMA_VERSION:
        connection.close()
        raise StoreError(
            f"[store] path = {str(path)!r}: schema version {version}, this program knows 1 to {SCHEMA_VERSION}; "
            "update the program or name another file"
        )
    return version


def _migrate(connection: sqlite3.Connection, version: int) -> None:
    """Bring an older database up to date, in one transaction."""
    if version == SCHEMA_VERSION:
        return
    with transaction(connection):
        for old in range(version, SCHEMA_VERSION):
            for statement in MIGRATIONS[old]:
                connection.execute(statement)


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """All or nothing of what is done in it."""
    try:
        connection.execute("BEGIN IMMEDIATE")
        yield connection
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


def is_full(error: OSError | sqlite3.Error) -> bool:
    """Whether the disk does not take what is written: it is full, or a quota is used up, or the card is failing."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    code = getattr(error, "sqlite_errorcode", 0)
    return code & 0xFF == sqlite3.SQLITE_FULL or code in REFUSED_WRITES
