"""Points as PLY (Turk, 1994) and PCD (Point Cloud Library, 0.7), both binary little-endian, x y z as float32."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def ply(points: FloatArray) -> bytes:
    """A PLY file of points of shape (m, 3), m, in the map's frame."""
    head = (
        "ply\nformat binary_little_endian 1.0\ncomment map frame, metres\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    return head.encode() + _packed(points)


def pcd(points: FloatArray) -> bytes:
    """A PCD file of points of shape (m, 3), m, in the map's frame."""
    n = len(points)
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    return head.encode() + _packed(points)


def _packed(points: FloatArray) -> bytes:
    return np.ascontiguousarray(points, dtype="<f4").tobytes()
