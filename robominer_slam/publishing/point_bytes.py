"""Points of the map stream as bytes: differences along whiskers' tracks, as numbers of one byte where they are small.

Points are ordered in strips across y, along x in each, as the whiskers drew them: neighbours in the list are then
neighbours on the ground, and most differences fit a byte, which zlib shortens further (docs/map-stream.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

PointArray = NDArray[np.int16]

#: Strips' width across y, in units of the points: 4 cm, the distance of two rows of whiskers.
STRIP = 8
#: A number of 16 bits and a sign takes three bytes at most.
_LONGEST = 3
#: Seven bits of each byte are the number's; the eighth says that more follow.
_MORE = 0x80


class PointBytesError(ValueError):
    """Bytes that are not so many points."""


def ordered(points: ArrayLike) -> PointArray:
    """Each point once, by strip, then x, y, z; shape (m, 3)."""
    unique = np.unique(np.asarray(points, dtype=np.int16).reshape(-1, 3), axis=0)
    x, y, z = unique.T
    return unique[np.lexsort((z, y, x, y // STRIP))]


def pack_points(points: PointArray) -> bytes:
    """All x, then all y, then all z: each the difference to the one before, the first to zero.

    Args:
        points: shape (m, 3).
    """
    steps = np.diff(points.T.astype(np.int32), axis=1, prepend=0).ravel()
    folded = np.where(steps < 0, -2 * steps - 1, 2 * steps).astype(np.uint32)
    places = np.arange(_LONGEST, dtype=np.uint32)
    sevens = (folded[:, None] >> (7 * places)) & 0x7F
    length = 1 + (folded >= 1 << 7).astype(np.int64) + (folded >= 1 << 14)
    follows = places + 1 < length[:, None]
    return (sevens | np.where(follows, _MORE, 0)).astype(np.uint8)[places < length[:, None]].tobytes()


def unpack_points(data: bytes, at: int, count: int) -> tuple[PointArray, int]:
    """The points that begin at a place, shape (count, 3), and the place behind them.

    Raises:
        PointBytesError: the bytes end before, or a number is too long or out of range.
    """
    if not count:
        return np.zeros((0, 3), dtype=np.int16), at
    numbers = 3 * count
    packed = np.frombuffer(data, dtype=np.uint8, count=min(len(data) - at, _LONGEST * numbers), offset=at)
    ends = np.flatnonzero(packed < _MORE)[:numbers]
    if len(ends) < numbers:
        raise PointBytesError(f"{count} points that are cut")
    starts = np.concatenate([[0], ends[:-1] + 1]).astype(np.intp)
    if int((ends - starts).max()) >= _LONGEST:
        raise PointBytesError("a number of more than three bytes")
    size = int(ends[-1]) + 1
    place = np.arange(size) - np.repeat(starts, ends - starts + 1)
    sevens = (packed[:size] & 0x7F).astype(np.int64) << (7 * place)
    folded = np.add.reduceat(sevens, starts)
    steps = np.where(folded & 1, -(folded + 1) // 2, folded // 2)
    points = np.cumsum(steps.reshape(3, count), axis=1)
    if not -(2**15) <= int(points.min()) <= int(points.max()) < 2**15:
        raise PointBytesError("a point out of range")
    return points.T.astype(np.int16), at + size
