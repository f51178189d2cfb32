"""Shared by the tests: where the public data sets lie, and packets of the `framed` protocol made by hand."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import pytest
from cobs import cobs
from hypothesis import settings

import robominer_slam  # noqa: F401 - first: it sets BLAS to one thread before numpy is loaded

settings.register_profile("default", deadline=None, max_examples=60)
settings.load_profile("default")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def make_packet(kind: int, sequence: int, time_us: int, payload: bytes, *, version: int = 1) -> bytes:
    """A `framed` packet as the interface describes it, written without the program's own code."""
    body = struct.pack("<BBHI", kind, version, sequence & 0xFFFF, time_us & 0xFFFFFFFF) + payload
    return cobs.encode(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


@pytest.fixture
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip("the public data sets are not beside this checkout")
    return SHARED_DATA
