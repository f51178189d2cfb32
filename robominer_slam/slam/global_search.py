"""Looks over a whole map and all headings for where a patch of touches may lie, by their heights on a coarse grid.

The sums of `correlative_search`, over every shift of the grid at once. Places are ranked by how much better the
map explains the patch than the patch's own mean height does,

    L = (nu / 2) log(var(z) / cost),   nu = effective touches on known ground,

so that a flat patch says nothing and a small overlap says little. The height of the patch over the map is free.
Cost and memory grow linearly with the map's area (times its logarithm): per heading six transforms of the grid, of
which only the best cells are kept.

Sources: as `correlative_search`; Konolige and Chou, "Markov localization using correlation" (IJCAI 1999), for the
correlation over all poses as a likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from robominer_slam.slam.correlative_search import SearchGrid, grid_around
from robominer_slam.slam.surface_registration import YAW

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

#: Cells kept per heading before the best of all are chosen.
KEPT_PER_HEADING = 40
#: Floor of a mean squared difference on the coarse grid, m2: half a cell at the ground's slope.
COST_FLOOR = 0.004**2


@dataclass(frozen=True, slots=True)
class GlobalPlaces:
    """The best places of a patch in a map, best first.

    Attributes:
        poses: x, y, yaw, z of the patch's frame in the map, shape (k, 4), m and rad.
        score: L of each, shape (k,), with nu = touches on known ground.
    """

    poses: FloatArray
    score: FloatArray


class GlobalSearch:
    """A map prepared for searches.

    Args:
        touches: of the map, shape (n, 3), m.
        cell: of the grid, m.
        reach: of the farthest touch of any patch from its frame's origin, m.
    """

    def __init__(self, touches: FloatArray, cell: float, reach: float) -> None:
        low = touches[:, :2].min(axis=0, initial=0.0 if not len(touches) else np.inf) - reach
        high = touches[:, :2].max(axis=0, initial=0.0 if not len(touches) else -np.inf) + reach
        self._origin, self._shape = grid_around(low, high, cell)
        self._cell, self._reach = cell, reach
        grid = SearchGrid(touches, self._origin, self._shape, cell)
        self._datum = grid.datum
        #: Number of known cells: the map's area.
        self.known_cells = int(grid.known.sum())
        self._known = grid.fft_known.astype(np.complex64)
        self._height = grid.fft_height.astype(np.complex64)
        self._square = grid.fft_square.astype(np.complex64)

    @property
    def area(self) -> float:
        """Of the known ground, m2."""
        return self.known_cells * self._cell**2

    def find(self, points: FloatArray, yaw_step: float, least_overlap: float, count: int) -> GlobalPlaces:
        """The best places, no two of them neighbours.

        Args:
            points: touches in their own frame, level, shape (m, 3), m.
            yaw_step: between headings, rad.
            least_overlap: share of the touches that must lie on known ground.
            count: places wanted.
        """
        inside = np.hypot(points[:, 0], points[:, 1]) < self._reach - 2.0 * self._cell
        points = points[inside]
        z = points[:, 2] - points[:, 2].mean()
        variance = float(z.var()) + COST_FLOOR
        least = max(least_overlap * len(points), 1.0)
        poses, scores = [], []
        for yaw in np.arange(0.0, 2.0 * np.pi, yaw_step):
            score, offset = self._over(points, z, float(yaw), variance, least)
            # Most of a large map is no place for the patch: to partition those too takes most of the time.
            best = np.flatnonzero(score > 0.0)
            if len(best) > KEPT_PER_HEADING:
                best = best[np.argpartition(score[best], len(best) - KEPT_PER_HEADING)[-KEPT_PER_HEADING:]]
            i, j = np.divmod(best, self._shape[1])
            xy = self._origin + np.column_stack([i, j]) * self._cell
            poses.append(np.column_stack([xy, np.full(len(best), yaw), offset[best]]))
            scores.append(score[best])
        every, score = np.concatenate(poses), np.concatenate(scores)
        every[:, 3] += self._datum - float(points[:, 2].mean()) if len(points) else 0.0
        chosen = apart(every, score, count, 2.5 * self._cell, 1.5 * yaw_step)
        return GlobalPlaces(every[chosen], score[chosen])

    def _over(
        self, points: FloatArray, z: FloatArray, yaw: float, variance: float, least: float
    ) -> tuple[FloatArray, FloatArray]:
        """L of every shift at one heading, and the patch's height over the map there; both flat."""
        c, s = np.cos(yaw), np.sin(yaw)
        at = np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]])
        ij = np.floor(at / self._cell + 0.5).astype(np.intp) % np.array(self._shape)
        place = ij[:, 0] * self._shape[1] + ij[:, 1]
        size = self._shape[0] * self._shape[1]
        sums = np.stack([np.bincount(place, weights=w, minlength=size) for w in (np.ones_like(z), z, z * z)])
        n, nz, nzz = np.conj(rfft2(sums.reshape(3, *self._shape).astype(np.float32)))
        products = np.stack(
            [
                n * self._known,
                nzz * self._known - 2.0 * nz * self._height + n * self._square,
                n * self._height - nz * self._known,
            ]
        )
        N, E, S = irfft2(products, s=self._shape).reshape(3, -1)
        enough = least <= N
        safe = np.where(enough, N, 1.0)
        offset = S / safe
        cost = np.maximum(E / safe - offset * offset, 0.0) + COST_FLOOR
        score = np.where(enough, 0.5 * N * np.log(variance / cost), -np.inf)
        return score, offset


def apart(poses: FloatArray, score: FloatArray, count: int, distance: float, angle: float) -> NDArray[np.int64]:
    """Indices of the best poses (n, >=3) of which no two are within both `distance` (m) and `angle` (rad)."""
    chosen: list[int] = []
    left = np.isfinite(score)
    order = np.argsort(-score, kind="stable")
    for k in order:
        if not left[k]:
            continue
        chosen.append(int(k))
        if len(chosen) == count:
            break
        turn = np.abs((poses[:, YAW] - poses[k, YAW] + np.pi) % (2.0 * np.pi) - np.pi)
        left &= (np.hypot(*(poses[:, :2] - poses[k, :2]).T) > distance) | (turn > angle)
    return np.array(chosen, dtype=np.int64)
