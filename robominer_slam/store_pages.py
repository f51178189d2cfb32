"""Reads rows out of a damaged SQLite file page by page, without SQLite: whatever else is broken, a whole page is read.

SQLite gives up a table where one page on the way to a row is damaged, and the file where its header or its schema is.
Rows lie in pages that describe themselves (https://www.sqlite.org/fileformat2.html), so each is read by itself. Frames
of the write-ahead log count in their order, also those that SQLite drops because one before them is damaged.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

Value = None | int | float | bytes | str

#: Pages of a new database, bytes: whatever changes is written in whole ones, and most changes are small. With 4096 a
#: keyframe costs 27 KiB, with 512 it costs 8.
PAGE_SIZE = 512
PAGE_SIZES = (512, 1024, 2048, 4096, 8192, 16384, 32768)
LEAF, FREE_OR_OVERFLOW = 0x0D, 0x00
#: First bytes of pages without rows: inner pages and leaves of indices, inner pages of tables.
OTHER_KINDS = (0x02, 0x05, 0x0A, FREE_OR_OVERFLOW)
DATABASE_HEADER, WAL_HEADER, FRAME_HEADER = 100, 32, 24
INTEGER_SIZES = (0, 1, 2, 3, 4, 6, 8)
#: No row of ours is longer; a longer length is damage, bytes.
LONGEST_ROW = 10_000_000


class PageError(ValueError):
    """A page or row that is damaged."""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of some table; which one, its values tell.

    Attributes:
        rowid: grows with the time of insertion.
        values: by column.
    """

    rowid: int
    values: tuple[Value, ...]


@dataclass(frozen=True, slots=True)
class WalFrames:
    """The frames of a write-ahead log since it was last begun anew.

    Attributes:
        pages: page number and place of its content in the file.
        commits: how many frames there are up to the last one that ends a transaction.
    """

    pages: tuple[tuple[int, int], ...]
    commits: int


def wal_commits(wal: Path) -> int:
    """How many frames of a log belong to whole transactions; 0 if it is not there. Raises OSError if not readable."""
    data = wal.read_bytes() if wal.exists() else b""
    told = int.from_bytes(data[8:12], "big")
    return wal_frames(data, told if told in PAGE_SIZES else PAGE_SIZE).commits


def wal_frames(data: bytes, page_size: int = PAGE_SIZE) -> WalFrames:
    """Frames that belong together by their salts; their checksums are not asked."""
    step = FRAME_HEADER + page_size
    if len(data) < WAL_HEADER + step:
        return WalFrames((), 0)
    salts = data[16:24] if _header_is_sound(data) else data[WAL_HEADER + 8 : WAL_HEADER + 16]
    pages: list[tuple[int, int]] = []
    commits = 0
    for at in range(WAL_HEADER, len(data) - step + 1, step):
        number, size_after = struct.unpack_from(">II", data, at)
        if data[at + 8 : at + 16] == salts:
            pages.append((number, at + FRAME_HEADER))
            if size_after:
                commits = (at - WAL_HEADER) // step + 1
    return WalFrames(tuple(pages), commits)


def merged(database: Path, wal: Path) -> bytes:
    """A database with its log taken into it, as one that has no log. Raises OSError if not readable."""
    image = bytearray(database.read_bytes())
    log = wal.read_bytes()
    told = int.from_bytes(log[8:12], "big")
    size = told if told in PAGE_SIZES else PAGE_SIZE
    frames = wal_frames(log, size)
    for number, place in frames.pages[: frames.commits]:
        image.extend(bytes(max(0, number * size - len(image))))
        image[(number - 1) * size : number * size] = log[place : place + size]
    image[18:20] = b"\x01\x01"  # not in the mode of logs
    return bytes(image)


def _header_is_sound(data: bytes) -> bool:
    """Whether the log's header has the checksum that it names."""
    magic = struct.unpack_from(">I", data)[0]
    if magic not in (0x377F0682, 0x377F0683):
        return False
    words = struct.unpack_from(">6I" if magic & 1 else "<6I", data)
    a = b = 0
    for n in range(0, 6, 2):
        a = (a + words[n] + b) & 0xFFFFFFFF
        b = (b + words[n + 1] + a) & 0xFFFFFFFF
    return struct.unpack_from(">II", data, 24) == (a, b)


class PageFile:
    """A database file and its log, as pages; both are only read.

    Attributes:
        damaged: pages with rows of which some could not be read.
    """

    def __init__(self, database: Path, wal: Path) -> None:
        """Read both; either may be missing.

        Raises:
            OSError: a file is there and cannot be read.
        """
        self._data = database.read_bytes() if database.exists() else b""
        self._wal = wal.read_bytes() if wal.exists() else b""
        told = int.from_bytes(self._data[16:18], "big")
        self._size = told if told in PAGE_SIZES else PAGE_SIZE
        self._versions: dict[int, list[int]] = {}
        for number, place in wal_frames(self._wal, self._size).pages:
            self._versions.setdefault(number, []).append(place)
        self.damaged = 0

    def rows(self) -> Iterator[Row]:
        """Every row that can be read of every table, of each page its newest version that is sound."""
        count = -(-len(self._data) // self._size)
        for number in [*range(1, count + 1), *sorted(n for n in self._versions if n > count)]:
            best: list[Row] = []
            for page in self._candidates(number):
                rows, sound = self._leaf(page, number)
                if len(rows) > len(best):
                    best = rows
                if sound:
                    best = rows
                    break
            else:
                self.damaged += 1
            yield from best

    def _candidates(self, number: int) -> Iterator[bytes]:
        """Versions of a page, the newest first."""
        for place in reversed(self._versions.get(number, [])):
            yield self._wal[place : place + self._size]
        page = self._data[(number - 1) * self._size : number * self._size]
        if page:
            yield page

    def _leaf(self, page: bytes, number: int) -> tuple[list[Row], bool]:
        """Rows of a page, and whether it is sound."""
        start = DATABASE_HEADER if number == 1 else 0
        if len(page) < start + 8:
            return [], False
        if page[start] != LEAF:
            return [], page[start] in OTHER_KINDS
        count = int.from_bytes(page[start + 3 : start + 5], "big")
        if start + 8 + 2 * count > len(page):
            return [], False
        rows = []
        for n in range(count):
            place = int.from_bytes(page[start + 8 + 2 * n : start + 10 + 2 * n], "big")
            try:
                rows.append(self._row(page, place))
            except (PageError, IndexError, struct.error, UnicodeDecodeError):
                continue  # counted: the page is not sound then
        return rows, len(rows) == count and len(page) == self._size

    def _row(self, page: bytes, place: int) -> Row:
        length, place = _varint(page, place)
        rowid, place = _varint(page, place)
        if length > LONGEST_ROW:
            raise PageError(f"row of {length} bytes")
        most, least = self._size - 35, (self._size - 12) * 32 // 255 - 23
        if length <= most:
            payload = page[place : place + length]
        else:
            local = least + (length - least) % (self._size - 4)
            local = local if local <= most else least
            payload = page[place : place + local]
            payload += self._overflow(int.from_bytes(page[place + local : place + local + 4], "big"), length - local)
        if len(payload) != length:
            raise PageError("row ends early")
        return Row(rowid, _record(payload))

    def _overflow(self, number: int, length: int) -> bytes:
        """The rest of a long row, from its chain of pages."""
        parts = []
        while length > 0:
            page = next(self._candidates(number), b"") if number else b""
            if len(page) < self._size:
                raise PageError(f"page {number} is missing")
            part = page[4 : 4 + min(length, self._size - 4)]
            parts.append(part)
            length -= len(part)
            number = int.from_bytes(page[:4], "big")
        return b"".join(parts)


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """SQLite's integer of variable length, and the place behind it."""
    value = 0
    for n in range(9):
        byte = data[place + n]
        if n == 8:
            value = value << 8 | byte
            break
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            break
    return value - (1 << 64) if value >= 1 << 63 else value, place + n + 1


def _record(payload: bytes) -> tuple[Value, ...]:
    """Values of a row."""
    end, place = _varint(payload, 0)
    kinds = []
    while place < end:
        kind, place = _varint(payload, place)
        kinds.append(kind)
    values: list[Value] = []
    at = end
    for kind in kinds:
        value, size = _value(payload, at, kind)
        values.append(value)
        at += size
    if at != len(payload):
        raise PageError("row has another length than its values")
    return tuple(values)


def _value(payload: bytes, at: int, kind: int) -> tuple[Value, int]:
    if kind == 0:
        return None, 0
    if 1 <= kind <= 6:
        size = INTEGER_SIZES[kind]
        return int.from_bytes(payload[at : at + size], "big", signed=True), size
    if kind == 7:
        return float(struct.unpack_from(">d", payload, at)[0]), 8
    if kind in (8, 9):
        return kind - 8, 0
    size = (kind - 12) // 2
    if size < 0 or at + size > len(payload):
        raise PageError(f"value of kind {kind}")
    data = payload[at : at + size]
    return (data, size) if kind % 2 == 0 else (data.decode(), size)
