"""Walls as whiskers on the robot's sides have touched them: planes through the touches around any place.

As the floor is a height over the plane, a wall is a depth over itself: along its horizontal direction and up. The
direction is that of the touches around, seen from above, since whiskers of one row touch along a line and leave open
how the wall leans. In these axes the regression is the floor's (`surface.planes_through`), and so is its variance.

A touch at q that lies r = n . q - depth off the wall, n the horizontal normal and a the horizontal direction along
it, has the slopes n - g_a a by x and y, and -g_z by z: the wall holds the robot across, and along by its roughness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robominer_slam.slam.surface import SurfaceModel, planes_through

FloatArray = NDArray[np.float64]

#: Touches that make up the wall at one place, at most: more than of a floor, since along one line they are dense.
NEIGHBOURS = 24
#: A touch may be farther from its wall than from the touches that tell how the wall runs there: so many reaches.
DEPTH_REACHES = 2.0
#: Cells, m, whose middles tell the wall's direction; how many, and within which distance, m.
DIRECTION_CELL = 0.03
DIRECTION_CELLS = 8
DIRECTION_REACH = 0.12
#: Touches spread less than so many times as far along as across, as variances, have no direction.
LEAST_ELONGATION = 6.0


@dataclass(frozen=True, slots=True)
class WallPatches:
    """Walls near m touches.

    Attributes:
        known: whether there are touches enough around, on a wall whose direction shows, shape (m,).
        residual: of the touches from the wall, along its normal, shape (m,), m; 0 where it is not known.
        along: the wall's horizontal direction, unit vectors, shape (2, m).
        slope: of the depth along the wall and up, shape (2, m).
        variance: of a new touch's depth, shape (m,), m2.
        slope_noise: covariance of the slope by the touches' errors, its aa, az and zz, shape (3, m).
    """

    known: NDArray[np.bool_]
    residual: FloatArray
    along: FloatArray
    slope: FloatArray
    variance: FloatArray
    slope_noise: FloatArray


class WallSurface:
    """Touches of walls with a search tree over them.

    Args:
        points: shape (n, 3), m.
        model: how they relate to the surface.
    """

    def __init__(self, points: FloatArray, model: SurfaceModel) -> None:
        self._model = model
        self._count = len(points)
        # And one more: where the search finds too few touches, it tells an index past the end.
        self._rows = np.zeros((len(points) + 1, 3))
        self._rows[:-1] = points
        self._along = np.zeros((2, len(points) + 1))
        self._directed = np.zeros(len(points) + 1, dtype=np.bool_)
        if len(points):
            self._tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
            self._along[:, :-1], self._directed[:-1] = directions(points[:, :2])

    def __len__(self) -> int:
        return self._count

    def at(self, q: FloatArray) -> WallPatches:
        """The walls near touches of shape (m, 3), m."""
        m, reach = len(q), self._model.reach
        if not self._count or not m:
            nothing = np.zeros((2, m))
            return WallPatches(np.zeros(m, dtype=np.bool_), np.zeros(m), nothing, nothing, np.ones(m), np.zeros((3, m)))
        found = self._tree.query(q, k=NEIGHBOURS, distance_upper_bound=DEPTH_REACHES * reach)
        distance, index = np.transpose(found[0]), np.transpose(found[1])
        nearest = index[0]
        along = self._along.take(nearest, axis=1)
        dx, dy, up = self._rows.take(index, axis=0).transpose(2, 0, 1) - q.T[:, None]
        offset = np.empty((3, *dx.shape))
        offset[0], offset[1], offset[2] = along[0] * dx + along[1] * dy, up, along[0] * dy - along[1] * dx
        squared = offset[0] ** 2 + offset[1] ** 2
        squared[(squared > reach**2) | (distance == np.inf)] = np.inf
        patches = planes_through(offset, squared, self._model)
        known = patches.known & self._directed.take(nearest)
        residual = np.where(known, -patches.height, 0.0)
        return WallPatches(known, residual, along, patches.slope.T, patches.variance, patches.slope_noise)


def directions(xy: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Which way the walls run at touches of shape (n, 2), m, by the touches around them.

    Returns:
        Unit vectors, shape (2, n), and whether the touches show a direction, shape (n,).
    """
    _, cell, count = np.unique(np.floor(xy / DIRECTION_CELL) @ [1.0, 1e7], return_inverse=True, return_counts=True)
    middle = np.stack([np.bincount(cell, xy[:, axis]) / count for axis in (0, 1)], axis=-1)
    found = cKDTree(middle).query(middle, k=DIRECTION_CELLS, distance_upper_bound=DIRECTION_REACH)
    index = np.asarray(found[1])
    near: NDArray[np.bool_] = np.asarray(found[0]) < np.inf
    weight = near / near.sum(axis=1, keepdims=True)
    around = np.concatenate([middle, np.zeros((1, 2))])[index] - middle[:, None]
    around -= (around * weight[:, :, None]).sum(axis=1, keepdims=True)
    xx, yy = (np.square(around) * weight[:, :, None]).sum(axis=1).T
    xy_product = (around[:, :, 0] * around[:, :, 1] * weight).sum(axis=1)
    angle = 0.5 * np.arctan2(2.0 * xy_product, xx - yy)
    spread = np.hypot(xx - yy, 2.0 * xy_product)
    elongated = (xx + yy + spread) > LEAST_ELONGATION * (xx + yy - spread)
    elongated &= near.sum(axis=1) > 2
    return np.stack([np.cos(angle), np.sin(angle)])[:, cell], elongated[cell]
