"""Touches as few bytes: one for each cell of ground, in steps of 2 mm, sorted so that neighbours differ little."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Touches are stored in steps of this, m: the tip of a whisker is known to 1.6 mm at best (docs/tip-assumption.md).
UNIT_M = 0.002
#: Sorted along x within strips of so many steps of y: the shorter way from touch to touch.
STRIP = 10
#: First byte of this format. What was written before it begins with zlib's own 0x78, and is in whole millimetres.
SORTED = b"\x02"
OLD_UNIT_M = 0.001


def pack_points(points: NDArray[np.floating], voxel_m: float = 0.0) -> bytes:
    """Touches, shape (m, 3), m, in another order.

    Args:
        points: none farther than 65 m from the origin; others are moved there.
        voxel_m: those in a cube of this size become one, at their mean; 0 to keep all.
    """
    thinned = _one_of_each_cell(np.asarray(points, dtype=np.float64), voxel_m)
    q = np.clip(np.rint(thinned / UNIT_M), -32768, 32767).astype("<i2")
    q = q[np.lexsort((q[:, 2], q[:, 0], q[:, 1] // STRIP))]
    steps = np.diff(q, axis=0, prepend=np.zeros((1, 3), "<i2"))  # wraps around at 16 bits, as does the sum
    octets = np.ascontiguousarray(steps.T.astype("<i2")).view(np.uint8).reshape(3, -1, 2)
    return SORTED + zlib.compress(octets[:, :, 0].tobytes() + octets[:, :, 1].tobytes(), 9)


def unpack_points(data: bytes) -> FloatArray:
    """Inverse of `pack_points`, shape (m, 3), m.

    Raises:
        zlib.error, ValueError: damaged.
    """
    if not data.startswith(SORTED):
        return np.frombuffer(zlib.decompress(data), dtype="<i2").reshape(-1, 3) * OLD_UNIT_M
    octets = np.frombuffer(zlib.decompress(data[1:]), dtype=np.uint8)
    if len(octets) % 6:
        raise ValueError(f"{len(octets)} bytes of touches; expected 6 for each")
    steps = np.ascontiguousarray(octets.reshape(2, 3, -1).transpose(1, 2, 0)).view("<i2")[:, :, 0]
    return np.cumsum(steps, axis=1, dtype=np.int16).T.astype(np.float64) * UNIT_M


def _one_of_each_cell(points: FloatArray, voxel_m: float) -> FloatArray:
    if voxel_m <= 0.0 or not len(points):
        return points
    _, cells = np.unique(np.floor(points / voxel_m).astype(np.int64), axis=0, return_inverse=True)
    cells = cells.ravel()
    counts = np.bincount(cells)
    means: FloatArray = np.empty((len(counts), 3))
    for axis in range(3):
        means[:, axis] = np.bincount(cells, points[:, axis]) / counts
    return means
