"""The few rules of little-endian CDR that hand-packed messages need: alignment, strings, the header.

Everything is aligned to its own size, counted from the first byte after the 4-byte encapsulation header.
"""

from __future__ import annotations

import struct

from drivers.ros_messages import CDR_LITTLE_ENDIAN, NANOSECONDS_PER_SECOND

__all__ = ["CDR_LITTLE_ENDIAN", "STAMP", "UINT32", "align", "padding", "stamp", "string"]

STAMP = struct.Struct("<iI")
UINT32 = struct.Struct("<I")


def align(at: int, size: int) -> int:
    """The first position from `at` on that is aligned to `size` (a power of two), bytes."""
    return (at + size - 1) & -size


def padding(at: int, size: int) -> bytes:
    """The zeros between `at` and the next position aligned to `size`."""
    return bytes(-at & size - 1)


def stamp(stamp_ns: int) -> bytes:
    """`builtin_interfaces/msg/Time` of integer nanoseconds; starts at a position aligned to 4."""
    return STAMP.pack(*divmod(stamp_ns, NANOSECONDS_PER_SECOND))


def string(text: str, at: int) -> bytes:
    """A string that is to stand at position `at` or after the padding it needs there."""
    encoded = text.encode() + b"\0"
    return padding(at, 4) + UINT32.pack(len(encoded)) + encoded
