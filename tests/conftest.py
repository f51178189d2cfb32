"""Shared by the tests: where the public data sets lie, and packets of the `framed` protocol made by hand."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from hypothesis import settings

from robominer_slam import geometry

settings.register_profile("default", deadline=None, max_examples=60)
settings.load_profile("default")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def planar(x: float, y: float, yaw: float) -> np.ndarray:
    """Pose matrix of a level body."""
    return geometry.T_from_xyyaw([x, y, yaw])


def make_packet(kind: int, sequence: int, time_us: int, payload: bytes, *, version: int = 1) -> bytes:
    """A `framed` packet as the interface describes it, written without the program's own code."""
    body = struct.pack("<BBHI", kind, version, sequence & 0xFFFF, time_us & 0xFFFFFFFF) + payload
    return cobs.encode(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


@pytest.fixture
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip("the public data sets are not beside this checkout")
    return SHARED_DATA
