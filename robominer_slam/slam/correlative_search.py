"""Looks over a whole range of positions and headings for where touches fit: by their heights, on a grid.

For one heading, the touches are summed into cells; then the sum of squared height differences for every shift at
once is a sum of correlations,

    E(s) = sum_p n_p (z_p - h(p + s))^2 = (z^2 * m) - 2 (z * h) + (n * h^2),   N(s) = n * m,

with m the cells where the surface is known: three transforms of the touches and three back per heading. So a search
costs the same whatever the shift, nothing is missed between guesses, and the whole cost surface says how unique its
minimum is. The common height offset is free within a prior: E loses (sum r)^2 / (N + sigma^2 / sigma_z^2).

Sources: Olson, "Real-time correlative scan matching" (ICRA 2009); Hess et al. (Cartographer, ICRA 2016) for the
search over the whole uncertainty; masked correlation by transforms: Padfield, "Masked object registration in the
Fourier domain" (IEEE TIP 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import ifft, irfft, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from robominer_slam.slam.surface_registration import YAW, X, Y

FloatArray = NDArray[np.float64]

#: A cell is known where the smoothed count of touches reaches this share of one touch.
KNOWN_WEIGHT = 0.12
#: The surface between lines of touches is filled over about this many cells.
FILL_CELLS = 1.0
#: Alternatives nearer than this belong to the same minimum, m and rad.
SAME_DISTANCE = 0.06
SAME_ANGLE = 0.10
# Transforms are in single precision: of a cost of (1 mm)^2 that leaves four digits, and places are whole cells.
#: Cells of all headings that are transformed at once: enough to be few calls, few enough to stay in a cache.
CELLS_AT_ONCE = 50_000


@dataclass(frozen=True, slots=True)
class SearchResult:
    """The best places of a search, best first.

    Attributes:
        poses: x, y, yaw of the touches' frame in the surface's, shape (k, 3), m and rad.
        cost: mean squared height difference there, shape (k,), m2.
        overlap: share of the touches on known cells, shape (k,).
    """

    poses: FloatArray
    cost: FloatArray
    overlap: FloatArray


class SearchGrid:
    """Heights of touches on a grid, prepared for searches.

    Args:
        points: touches, shape (n, 3), m.
        origin: x, y of the grid's corner, m.
        shape: cells along x and y.
        cell: size of a cell, m.
    """

    def __init__(self, points: FloatArray, origin: FloatArray, shape: tuple[int, int], cell: float) -> None:
        self.origin, self.shape, self.cell = origin, shape, cell
        total, count = _binned(points[:, :2] - origin, points[:, 2], shape, cell)
        filled = (0.0, FILL_CELLS, FILL_CELLS)
        total, count = gaussian_filter(np.stack([total, count]), filled, mode="constant", truncate=2.0)
        known = count > KNOWN_WEIGHT * gaussian_peak()
        height = np.where(known, total / np.where(known, count, 1.0), 0.0)
        # About the mean height: squares of small numbers lose no digits.
        self.datum = float(height[known].mean()) if known.any() else 0.0
        height = np.where(known, height - self.datum, 0.0)
        self.known = known
        self.fft_known, self.fft_height, self.fft_square = rfft2(np.stack([known, height, height**2], dtype=np.float32))


def gaussian_peak() -> float:
    """Weight that the filling leaves in the cell of a single touch."""
    return 1.0 / (2.0 * np.pi * FILL_CELLS**2)


def search(
    grid: SearchGrid,
    points: FloatArray,
    centre: FloatArray,
    half_window: FloatArray,
    yaw_step: float,
    least_overlap: float,
    height_prior: float,
    count: int = 4,
) -> SearchResult:
    """The best places within a window, no two of them the same minimum.

    Args:
        grid: the surface; must reach beyond the touches at every pose of the window, or overlap is lost.
        points: touches in their own frame, shape (m, 3), m, z comparable with the surface's up to the prior.
        centre: of the window: x, y (m), yaw (rad), shape (3,).
        half_window: its half size, shape (3,).
        yaw_step: between the headings tried, rad.
        least_overlap: places with less of the touches on known cells do not count.
        height_prior: sigma^2 / sigma_z^2, noise of a touch against that of the common height; 0 frees the height.
        count: places wanted.
    """
    yaws = headings(centre[YAW], half_window[YAW], yaw_step)
    reach = np.ceil(half_window[:2] / grid.cell).astype(int)
    costs = np.full((len(yaws), 2 * reach[0] + 1, 2 * reach[1] + 1), np.inf)
    overlaps = np.zeros_like(costs)
    weights = np.stack([np.ones(len(points)), points[:, 2] - grid.datum, (points[:, 2] - grid.datum) ** 2])
    together = max(1, CELLS_AT_ONCE // (grid.shape[0] * grid.shape[1]))
    for first in range(0, len(yaws), together):
        some = slice(first, first + together)
        at = turned(points, yaws[some]) + (centre[:2] - grid.origin)
        n, nz, nzz = _transformed(at, weights, grid.shape, grid.cell)
        products = np.empty((3, *n.shape), dtype=np.complex64)
        np.multiply(n, grid.fft_known, out=products[0])
        products[1] = nzz * grid.fft_known - 2.0 * nz * grid.fft_height + n * grid.fft_square
        products[2] = nz * grid.fft_known - n * grid.fft_height
        N, E, S = _shifted(products, grid.shape, reach)
        # A whole number of touches: rounding must not decide whether they are enough.
        N, E, S = np.rint(N).astype(np.float64), E.astype(np.float64), S.astype(np.float64)
        enough = least_overlap * len(points) <= N
        safe = np.where(enough, N, 1.0)
        costs[some] = np.where(enough, np.maximum(E - S * S / (safe + height_prior), 0.0) / safe, np.inf)
        overlaps[some] = N / len(points)
    return _minima(costs, overlaps, yaws, centre, reach, grid.cell, count)


def _minima(
    costs: FloatArray,
    overlaps: FloatArray,
    yaws: FloatArray,
    centre: FloatArray,
    reach: NDArray[np.int_],
    cell: float,
    count: int,
) -> SearchResult:
    poses, found, shares = [], [], []
    left = costs.copy()
    dx = (np.arange(costs.shape[1]) - reach[0]) * cell
    dy = (np.arange(costs.shape[2]) - reach[1]) * cell
    for _ in range(count):
        k, i, j = np.unravel_index(int(np.argmin(left)), left.shape)
        if not np.isfinite(left[k, i, j]):
            break
        poses.append([centre[X] + dx[i], centre[Y] + dy[j], yaws[k]])
        found.append(costs[k, i, j])
        shares.append(overlaps[k, i, j])
        same = (np.abs(yaws - yaws[k]) <= SAME_ANGLE)[:, None, None] & (
            (dx[:, None] - dx[i]) ** 2 + (dy[None, :] - dy[j]) ** 2 <= SAME_DISTANCE**2
        )
        left[same] = np.inf
    return SearchResult(np.array(poses).reshape(-1, 3), np.array(found), np.array(shares))


def _binned(xy: FloatArray, z: FloatArray, shape: tuple[int, int], cell: float) -> tuple[FloatArray, FloatArray]:
    # Axis by axis: rows of two are slow.
    i, j = np.floor(xy[:, 0] / cell), np.floor(xy[:, 1] / cell)
    inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
    place = (i[inside] * shape[1] + j[inside]).astype(np.intp)
    size = shape[0] * shape[1]
    total: FloatArray = np.bincount(place, weights=z[inside], minlength=size).astype(np.float64)
    count: FloatArray = np.bincount(place, minlength=size).astype(np.float64)
    return total.reshape(shape), count.reshape(shape)


def headings(centre: float, half_window: float, step: float) -> FloatArray:
    """Headings of a search, shape (k,), all in rad."""
    turns = int(np.ceil(half_window / step))
    return np.asarray(centre + np.arange(-turns, turns + 1) * step, dtype=np.float64)


def turned(points: FloatArray, yaws: FloatArray) -> FloatArray:
    """Points (m, 2 or more), their x and y, turned by each of k headings, rad: shape (k, m, 2)."""
    c, s = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    xy = np.empty((len(yaws), len(points), 2))
    xy[:, :, 0] = c * points[:, 0] - s * points[:, 1]
    xy[:, :, 1] = s * points[:, 0] + c * points[:, 1]
    return xy


def _transformed(at: FloatArray, weights: FloatArray, shape: tuple[int, int], cell: float) -> NDArray[np.complex64]:
    """Conjugate transforms of weights summed per cell: multiplied with another's, a correlation.

    Args:
        at: x and y of m touches at each of k headings, from the grid's corner, shape (k, m, 2), m.
        weights: of the touches, w sets, shape (w, m).
        shape, cell: of the grid.

    Returns:
        Shape (w, k, *that of a transform).
    """
    ij = np.floor(at / cell).astype(np.intp) % np.array(shape)  # a shift wraps round as the transform does
    k, size = len(at), shape[0] * shape[1]
    place = (ij[:, :, 0] * shape[1] + ij[:, :, 1] + np.arange(k)[:, None] * size).reshape(-1)
    sums = np.stack([np.bincount(place, weights=np.tile(w, k), minlength=k * size) for w in weights], dtype=np.float32)
    transforms = rfft2(sums.reshape(len(weights), k, *shape))
    return np.conjugate(transforms, out=transforms)


def _shifted(products: NDArray[np.complex64], shape: tuple[int, int], reach: NDArray[np.int_]) -> NDArray[np.float32]:
    """Transforms back, shifts from -reach to reach along the last two axes alone: of other rows one half is spared."""
    rows = np.arange(-reach[0], reach[0] + 1)
    columns = np.arange(-reach[1], reach[1] + 1)
    along_x = ifft(products, axis=-2, overwrite_x=True).take(rows, axis=-2, mode="wrap")
    cut: NDArray[np.float32] = irfft(along_x, n=shape[1], axis=-1).take(columns, axis=-1, mode="wrap")
    return cut


def grid_around(low: FloatArray, high: FloatArray, cell: float) -> tuple[FloatArray, tuple[int, int]]:
    """Corner and shape of a grid over a box; shapes that transform fast."""
    cells = np.ceil((high - low) / cell).astype(int) + 1
    return low, (next_fast_len(int(cells[0]), real=True), next_fast_len(int(cells[1]), real=True))


def grid_within(
    low: FloatArray, corners: tuple[FloatArray, FloatArray], cell: float
) -> tuple[FloatArray, tuple[int, int]]:
    """As `grid_around`, for the part between two corners of a larger grid from `low` on: its cells are the same."""
    first = np.floor((corners[0] - low) / cell)
    return grid_around(low + first * cell, corners[1], cell)
