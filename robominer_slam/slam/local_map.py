"""The ground touched lately, in odom: what new scans are matched with before there is any loop to close.

First come, first kept: a cell that has its points takes no more until they are old. So a scan is matched with the
oldest touches near it and not with what was just written from the same drifting poses, which would confirm the
drift. Touches become a target only some centimetres of travel after they were made, for the same reason, and leave
after `keep`: what was touched longer ago may have drifted by more than a match from the present pose can bridge,
and is the loop closures' business.

Source: the voxel map of KISS-ICP (Vizzo et al., RA-L 2023) keeps its first points too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.surface import Surface, SurfaceModel

FloatArray = NDArray[np.float64]

#: Rows of cells in a column: any map of a few metres has fewer.
KEY_STRIDE = 1 << 24


class LocalMap:
    """Touches of the last metres.

    Args:
        model: how touches make a surface.
        keep: travel after which a touch leaves, m.
        age: travel before a touch becomes a target, m.
        cell: size of a cell, m.
        per_cell: touches that a cell keeps.
        rebuild: travel between two updates of the target, m.
    """

    def __init__(
        self, model: SurfaceModel, keep: float, age: float, cell: float, per_cell: int, rebuild: float
    ) -> None:
        self._model = model
        self._keep, self._age = keep, age
        self._cell, self._per_cell, self._rebuild = cell, per_cell, rebuild
        self._points = np.zeros((0, 3))
        self._travelled = np.zeros(0)
        self._waiting: list[tuple[float, FloatArray]] = []
        self._built = -np.inf
        self.surface = Surface(self._points, model)

    def add(self, travelled: float, points: FloatArray) -> None:
        """Add touches in odom, shape (m, 3), m, made when `travelled` m had been driven."""
        self._waiting.append((travelled, points))

    def update(self, travelled: float, centre: FloatArray, radius: float) -> None:
        """Bring the target up to date, if it is time.

        Args:
            travelled: way driven up to now, m.
            centre, radius: the target need only reach this far, m.
        """
        if travelled - self._built < self._rebuild:
            return
        self._built = travelled
        ripe = 0
        while ripe < len(self._waiting) and self._waiting[ripe][0] <= travelled - self._age:
            ripe += 1
        new, self._waiting = self._waiting[:ripe], self._waiting[ripe:]
        points = np.concatenate([self._points, *(p for _, p in new)])
        ages = np.concatenate([self._travelled, *(np.full(len(p), t) for t, p in new)])
        young = ages >= travelled - self._keep
        points, ages = points[young], ages[young]
        kept = self._first_per_cell(points)
        self._points, self._travelled = points[kept], ages[kept]
        near = np.abs(self._points[:, :2] - centre).max(axis=1) <= radius
        self.surface = Surface(self._points[near], self._model)

    def clear(self) -> None:
        """Forget everything: after a jump of odom the old touches are elsewhere."""
        self._points, self._travelled, self._waiting = np.zeros((0, 3)), np.zeros(0), []
        self._built = -np.inf
        self.surface = Surface(self._points, self._model)

    def _first_per_cell(self, points: FloatArray) -> NDArray[np.intp]:
        """Indices, ascending, of the first `per_cell` points of each cell; points are in the order of their age."""
        if not len(points):
            return np.zeros(0, dtype=np.intp)
        ij = np.floor(points[:, :2] / self._cell).astype(np.int64)
        key = ij[:, 0] * KEY_STRIDE + ij[:, 1]
        order = np.argsort(key, kind="stable")
        key = key[order]
        # One is too many where the cell is that of the touch so many places before it.
        kept = np.ones(len(points), dtype=np.bool_)
        kept[order[self._per_cell :][key[self._per_cell :] == key[: -self._per_cell]]] = False
        return np.flatnonzero(kept)
