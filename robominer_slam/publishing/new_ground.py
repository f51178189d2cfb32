"""Which points of a keyframe are told: one for each cell of ground that the map's nearby keyframes have not told.

A robot that stands, turns or comes back touches the same ground again and again; a remote operator needs it once. The
keyframes themselves keep all their points (`map/cloud` has them), the stream does not carry them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.publishing.map_state import StreamKeyframe
from robominer_slam.publishing.point_bytes import PointArray

FloatArray = NDArray[np.float64]

#: Cells along each axis that a key of 63 bits has room for.
_AXIS = 1 << 21


def new_ground(
    points: PointArray, points_m: FloatArray, T: FloatArray, neighbours: Iterable[StreamKeyframe], cell: float
) -> PointArray:
    """The points to be told, in the order they had.

    Args:
        points, points_m: of a keyframe, as the stream has them and in m, both shape (m, 3).
        T: its pose T_map_base, shape (4, 4).
        neighbours: of the map, those near enough to have touched the same ground.
        cell: edge of a cell, m.
    """
    if not len(points):
        return points
    keys = _cells(geometry.transform_points(T, points_m), cell)
    _, first = np.unique(keys, return_index=True)
    told = [
        _cells(geometry.transform_points(geometry.from_vector7(one.vector7()), one.points_m()), cell)
        for one in neighbours
        if len(one.points)
    ]
    if told:
        first = first[~np.isin(keys[first], np.concatenate(told))]
    return points[np.sort(first)]


def _cells(places: FloatArray, cell: float) -> NDArray[np.int64]:
    """A number for each place's cell, shape (m,)."""
    index = np.floor(places / cell).astype(np.int64) + _AXIS // 2
    keys: NDArray[np.int64] = (index[:, 0] * _AXIS + index[:, 1]) * _AXIS + index[:, 2]
    return keys
