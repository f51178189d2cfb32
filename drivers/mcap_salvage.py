"""Reads an MCAP file that was cut or damaged: record by record from the start, as far as it goes.

A seeking reader goes by the index at the end of the file and finds nothing in a file that has no end. This one
needs no index; it steps over a damaged chunk, and stops without an error where the file breaks off.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from zstandard import ZstdError

Record: TypeAlias = Schema | Channel | Message | Attachment | Metadata

#: What mcap and its decompressors raise on damaged bytes (lz4: RuntimeError; checksums: ValueError).
DAMAGE = (McapError, ZstdError, RuntimeError, struct.error, ValueError, IndexError, KeyError, MemoryError)


class Salvage:
    """One pass over a file.

    Attributes:
        damaged_chunks: chunks that were stepped over.
        cut: True if the file broke off before its end record.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.damaged_chunks = 0
        self.cut = False

    def records(self) -> Iterator[Record]:
        """Schemas, channels, messages, attachments and metadata in the file's order.

        Raises:
            OSError: the file cannot be read.
        """
        self.damaged_chunks = 0
        self.cut = False
        with self._path.open("rb") as file:
            records = iter(StreamReader(file, emit_chunks=True).records)
            while True:
                try:
                    record = next(records)
                except StopIteration:
                    return
                except DAMAGE:
                    self.cut = True
                    return
                if isinstance(record, Chunk):
                    yield from self._chunk(record)
                elif isinstance(record, Record):
                    yield record

    def _chunk(self, chunk: Chunk) -> Iterator[Record]:
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except DAMAGE:
            self.damaged_chunks += 1
            return
        for record in records:
            if isinstance(record, Record):
                yield record
