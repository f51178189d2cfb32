"""Heights of points on a horizontal grid, and the obstacles that steps between them make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

FloatArray = NDArray[np.float64]

#: Bound on a grid's cells: 64 km2 of 5 cm cells do not fit on a 1 GB board.
MAX_CELLS = 4_000_000
UNKNOWN, FREE, OCCUPIED = -1, 0, 100


class GridSizeError(ValueError):
    """The points spread over more cells than the bound."""


@dataclass(frozen=True, slots=True)
class HeightGrid:
    """Mean height per cell.

    Attributes:
        origin: x and y of the corner of cell (0, 0), m.
        cell: size, m.
        height: shape (ny, nx), m; NaN where nothing was touched.
    """

    origin: tuple[float, float]
    cell: float
    height: FloatArray


def height_grid(points: FloatArray, cell: float) -> HeightGrid:
    """Mean z of the points in each cell of size `cell`, m; points of shape (m, 3).

    Raises:
        GridSizeError: more than 4 million cells.
    """
    if not len(points):
        return HeightGrid((0.0, 0.0), cell, np.full((1, 1), np.nan))
    low = np.floor(points[:, :2].min(axis=0) / cell)
    ij = (np.floor(points[:, :2] / cell) - low).astype(np.intp)
    nx, ny = (int(n) for n in ij.max(axis=0) + 1)
    if nx * ny > MAX_CELLS:
        raise GridSizeError(f"a grid of {nx} x {ny} cells of {cell} m; expected at most {MAX_CELLS} cells")
    place = ij[:, 1] * nx + ij[:, 0]
    total = np.bincount(place, weights=points[:, 2], minlength=nx * ny)
    number = np.bincount(place, minlength=nx * ny)
    with np.errstate(invalid="ignore"):
        height = np.where(number > 0, total / number, np.nan)
    return HeightGrid((float(low[0] * cell), float(low[1] * cell)), cell, height.reshape(ny, nx))


def occupancy(grid: HeightGrid, obstacle_height: float) -> NDArray[np.int8]:
    """Occupied (100) where heights within the cell's eight neighbours differ by more than `obstacle_height`, m.

    Untouched cells are unknown (-1), the rest free (0); shape (ny, nx).
    """
    known = np.isfinite(grid.height)
    highest = maximum_filter(np.where(known, grid.height, -np.inf), size=3, mode="nearest")
    lowest = minimum_filter(np.where(known, grid.height, np.inf), size=3, mode="nearest")
    step = highest - lowest
    cells = np.where(known, np.where(step > obstacle_height, OCCUPIED, FREE), UNKNOWN)
    return cells.astype(np.int8)
