"""What is different between two saved maps: poses of the keyframes that both have, and heights where both touched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.map_files.formats import cloud
from robominer_slam.mapping.height_grid import HeightGrid, height_grid
from robominer_slam.slam.saved_map import SavedMap

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MapDifference:
    """Of a second map against a first.

    Attributes:
        common, only_first, only_second: keyframes by stamp, numbers of them.
        moved: distance between the poses of those in common, shape (common,), m.
        turned: angle between them, shape (common,), rad.
        cells_common, cells_first, cells_second: touched cells: in both, in one alone.
        height: of the second over the first in the common cells, shape (cells_common,), m.
    """

    common: int
    only_first: int
    only_second: int
    moved: FloatArray
    turned: FloatArray
    cells_common: int
    cells_first: int
    cells_second: int
    height: FloatArray


def difference(first: SavedMap, second: SavedMap, cell: float) -> MapDifference:
    """Compare two maps of the same frame; heights by cells of size `cell`, m."""
    stamps = [{keyframe.stamp_ns: k for k, keyframe in enumerate(one.keyframes)} for one in (first, second)]
    both = sorted(stamps[0].keys() & stamps[1].keys())
    a = first.poses[[stamps[0][stamp] for stamp in both]].reshape(-1, 4, 4)
    b = second.poses[[stamps[1][stamp] for stamp in both]].reshape(-1, 4, 4)
    step = geometry.inverse(a) @ b
    heights = [_cells(height_grid(cloud(one), cell)) for one in (first, second)]
    common = sorted(heights[0].keys() & heights[1].keys())
    return MapDifference(
        common=len(both),
        only_first=len(stamps[0]) - len(both),
        only_second=len(stamps[1]) - len(both),
        moved=np.linalg.norm(step[:, :3, 3], axis=1),
        turned=np.arccos(np.clip(0.5 * (np.trace(step[:, :3, :3], axis1=1, axis2=2) - 1.0), -1.0, 1.0)),
        cells_common=len(common),
        cells_first=len(heights[0]) - len(common),
        cells_second=len(heights[1]) - len(common),
        height=np.array([heights[1][place] - heights[0][place] for place in common]),
    )


def _cells(grid: HeightGrid) -> dict[tuple[int, int], float]:
    """Heights by cell, counted from the map's origin."""
    row, column = np.nonzero(np.isfinite(grid.height))
    x0, y0 = (round(value / grid.cell) for value in grid.origin)
    return {
        (x0 + i, y0 + j): h
        for i, j, h in zip(column.tolist(), row.tolist(), grid.height[row, column].tolist(), strict=True)
    }
