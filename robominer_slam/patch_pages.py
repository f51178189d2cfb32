"""Touches paged to a temporary SQLite file: what is in it is worth nothing after the drive, so it is never synced."""

from __future__ import annotations

import sqlite3
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class SqlitePages:
    """A `PatchPages`; the file is made with the first page and has no name, so it goes with the process.

    Args:
        folder: on a disk; None for the system's folder of temporary files.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._connection: sqlite3.Connection | None = None

    def write(self, key: int, points: NDArray[np.float32]) -> None:
        """Keep the touches of a keyframe, shape (m, 3), m, as float32."""
        data = np.asarray(points, dtype="<f4").tobytes()
        self._do("INSERT OR REPLACE INTO patches VALUES (?, ?)", (key, data))

    def read(self, key: int) -> FloatArray:
        """Touches that were written, shape (m, 3), m.

        Raises:
            KeyError: nothing was written under this key.
        """
        row = self._do("SELECT points FROM patches WHERE id = ?", (key,))
        if row is None:
            raise KeyError(key)
        return np.frombuffer(row[0], dtype="<f4").reshape(-1, 3).astype(np.float64)

    def delete(self, key: int) -> None:
        """Let go of a keyframe's touches; SQLite uses the room again."""
        self._do("DELETE FROM patches WHERE id = ?", (key,))

    def close(self) -> None:
        """Let go of the file; must not be used again."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _do(self, statement: str, values: tuple[int | bytes, ...]) -> tuple[bytes] | None:
        try:
            row: tuple[bytes] | None = self._opened().execute(statement, values).fetchone()
        except sqlite3.Error as error:
            raise OSError(f"touches cannot be paged to disk: {error}") from error
        return row

    def _opened(self) -> sqlite3.Connection:
        if self._connection is None:
            with tempfile.NamedTemporaryFile(
                dir=self._folder, prefix="robominer-pages-", suffix=".db", delete=False
            ) as file:
                path = Path(file.name)
            # Used by one thread at a time, but made by one and dropped by another.
            self._connection = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._connection.execute("PRAGMA journal_mode = OFF")
            self._connection.execute("PRAGMA synchronous = OFF")
            self._connection.execute("PRAGMA cache_size = -256")
            self._connection.execute("CREATE TABLE patches (id INTEGER PRIMARY KEY, points BLOB NOT NULL)")
            path.unlink()
        return self._connection
