"""Whether touches lie on ground that the map has already: on a grid of cells, those of the map grown by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def covered_share(points: FloatArray, ground: FloatArray, cell: float) -> float:
    """Share of touches (m, 2 or more columns), m, that have a touch of `ground`, shape (n, 2 or more), near.

    Near is: in the same cell, or in one of the four beside it; cells of size `cell`, m.
    """
    if not len(points):
        return 1.0
    own = np.floor(points[:, :2] / cell).astype(np.int64)
    low = own.min(axis=0) - 1
    shape = own.max(axis=0) + 2 - low
    # Axis by axis: rows of two are slow.
    x, y = np.floor(ground[:, 0] / cell) - low[0], np.floor(ground[:, 1] / cell) - low[1]
    there = (x >= 0) & (x < shape[0]) & (y >= 0) & (y < shape[1])
    known = np.zeros(shape, dtype=np.bool_)
    known[x[there].astype(np.intp), y[there].astype(np.intp)] = True
    near = known.copy()
    near[1:] |= known[:-1]
    near[:-1] |= known[1:]
    near[:, 1:] |= known[:, :-1]
    near[:, :-1] |= known[:, 1:]
    own -= low
    return float(near[own[:, 0], own[:, 1]].mean())
