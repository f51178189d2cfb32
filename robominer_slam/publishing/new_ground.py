"""Which points of a keyframe are told: one for each cell of ground that the map's nearby keyframes have not told.

A robot that stands, turns or comes back touches the same ground again and again; a remote operator needs it once. The
keyframes themselves keep all their points (`map/cloud` has them), the stream does not carry them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.publishing.map_state import POINT_UNIT_M, StreamKeyframe, vectors7
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
    places = geometry.transform_points(T, points_m)
    keys = _cells(places, cell)
    _, first = np.unique(keys, return_index=True)
    told = _placed([one for one in neighbours if len(one.points)])
    inside = ((told >= places.min(axis=0) - cell) & (told <= places.max(axis=0) + cell)).all(axis=1)
    if inside.any():
        first = first[~np.isin(keys[first], _cells(told[inside], cell))]
    return points[np.sort(first)]


def _placed(keyframes: list[StreamKeyframe]) -> FloatArray:
    """Points of several keyframes in map, shape (m, 3), m."""
    if not keyframes:
        return np.zeros((0, 3))
    T = geometry.from_vector7(vectors7([one.pose for one in keyframes]))
    points = np.concatenate([one.points for one in keyframes]) * POINT_UNIT_M
    of = np.repeat(np.arange(len(keyframes)), [len(one.points) for one in keyframes])
    placed: FloatArray = np.einsum("mij,mj->mi", T[of, :3, :3], points) + T[of, :3, 3]
    return placed


def _cells(places: FloatArray, cell: float) -> NDArray[np.int64]:
    """A number for each place's cell, shape (m,)."""
    index = np.floor(places / cell).astype(np.int64) + _AXIS // 2
    keys: NDArray[np.int64] = (index[:, 0] * _AXIS + index[:, 1]) * _AXIS + index[:, 2]
    return keys
