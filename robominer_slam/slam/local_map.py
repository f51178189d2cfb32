"""The ground touched lately, in odom: what new scans are matched with before there is any loop to close.

First come, first kept: a cell that has its points takes no more until they are old. So a scan is matched with the
oldest touches near it and not with what was just written from the same drifting poses, which would confirm the
drift. Touches become a target only some centimetres of travel after they were made, for the same reason, and leave
after `keep`: what was touched longer ago may have drifted by more than a match from the present pose can bridge,
and is the loop closures' business.

Source: the voxel map of KISS-ICP (Vizzo et al., RA-L 2023) keeps its first points too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Rows of cells in a column: any map of a few metres has fewer.
KEY_STRIDE = 1 << 24


#: What touches make up: the floor's surface, or that of walls.
SurfaceT = TypeVar("SurfaceT")


class LocalMap(Generic[SurfaceT]):
    """Touches of the last metres.

    Args:
        surface_of: what touches of shape (n, 3), m, make up.
        keep: travel after which a touch leaves, m.
        age: travel before a touch becomes a target, m.
        cell: size of a cell, m.
        per_cell: touches that a cell keeps.
        rebuild: travel between two updates of the target, m.
    """

    #: In the order of their age: places, shape (3, n), way driven when they were made, their cells.
    _points: FloatArray
    _travelled: FloatArray
    _cells: NDArray[np.int64]
    _built: float

    def __init__(
        self,
        surface_of: Callable[[FloatArray], SurfaceT],
        keep: float,
        age: float,
        cell: float,
        per_cell: int,
        rebuild: float,
    ) -> None:
        self._surface_of = surface_of
        self._keep, self._age = keep, age
        self._cell, self._per_cell, self._rebuild = cell, per_cell, rebuild
        self._waiting: list[tuple[float, FloatArray]] = []
        self.clear()

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
        oldest = travelled - self._keep
        leaving = int(np.searchsorted(self._travelled, oldest))
        self._leave(self._cells[:leaving].tolist())
        ripe = 0
        while ripe < len(self._waiting) and self._waiting[ripe][0] <= travelled - self._age:
            ripe += 1
        new, self._waiting = [one for one in self._waiting[:ripe] if one[0] >= oldest], self._waiting[ripe:]
        points = np.concatenate([np.zeros((0, 3)), *(points for _, points in new)])
        cells = self._cells_of(points)
        kept = self._enter(cells.tolist())
        made = np.concatenate([np.zeros(0), *(np.full(len(points), when) for when, points in new)])
        self._points = np.concatenate([self._points[:, leaving:], points[kept].T], axis=1)
        self._travelled = np.concatenate([self._travelled[leaving:], made[kept]])
        self._cells = np.concatenate([self._cells[leaving:], cells[kept]])
        (low_x, low_y), (high_x, high_y) = (centre - radius).tolist(), (centre + radius).tolist()
        x, y, _ = self._points
        (near,) = ((x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)).nonzero()
        self.surface = self._surface_of(np.ascontiguousarray(self._points.take(near, axis=1).T))

    def clear(self) -> None:
        """Forget everything: after a jump of odom the old touches are elsewhere."""
        self._points, self._travelled, self._cells = np.zeros((3, 0)), np.zeros(0), np.zeros(0, dtype=np.int64)
        self._taken: dict[int, int] = {}
        self._waiting = []
        self._built = -np.inf
        self.surface = self._surface_of(np.zeros((0, 3)))

    def _cells_of(self, points: FloatArray) -> NDArray[np.int64]:
        ij = np.floor(points[:, :2] / self._cell).astype(np.int64)
        cells: NDArray[np.int64] = ij[:, 0] * KEY_STRIDE + ij[:, 1]
        return cells

    def _leave(self, cells: list[int]) -> None:
        """Make room in the cells of touches that leave, a cell for each of them."""
        taken = self._taken
        for cell in cells:
            left = taken[cell] - 1
            if left:
                taken[cell] = left
            else:
                del taken[cell]

    def _enter(self, cells: list[int]) -> NDArray[np.intp]:
        """Take touches into their cells, in the order of their age; which found room, ascending."""
        taken, kept = self._taken, []
        for k, cell in enumerate(cells):
            here = taken.get(cell, 0)
            if here < self._per_cell:
                taken[cell] = here + 1
                kept.append(k)
        return np.array(kept, dtype=np.intp)
