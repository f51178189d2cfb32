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
from scipy.fft import irfft2, next_fast_len, rfft2
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
        total = gaussian_filter(total, FILL_CELLS, mode="constant", truncate=2.0)
        count = gaussian_filter(count, FILL_CELLS, mode="constant", truncate=2.0)
        known = count > KNOWN_WEIGHT * gaussian_peak()
        height = np.where(known, total / np.where(known, count, 1.0), 0.0)
        # About the mean height: squares of small numbers lose no digits.
        self.datum = float(height[known].mean()) if known.any() else 0.0
        height = np.where(known, height - self.datum, 0.0)
        self.known = known
        self.fft_known = rfft2(known.astype(np.float64))
        self.fft_height = rfft2(height)
        self.fft_square = rfft2(height**2)


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
    turns = int(np.ceil(half_window[YAW] / yaw_step))
    yaws = centre[YAW] + np.arange(-turns, turns + 1) * yaw_step
    reach = np.ceil(half_window[:2] / grid.cell).astype(int)
    costs = np.full((len(yaws), 2 * reach[0] + 1, 2 * reach[1] + 1), np.inf)
    overlaps = np.zeros_like(costs)
    z = points[:, 2] - grid.datum
    for k, yaw in enumerate(yaws):
        c, s = np.cos(yaw), np.sin(yaw)
        xy = np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]])
        at = xy + centre[:2] - grid.origin
        n, nz, nzz = _transformed(at, z, grid.shape, grid.cell)
        N = _window(irfft2(n * grid.fft_known, s=grid.shape), reach)
        E = _window(
            irfft2(nzz * grid.fft_known - 2.0 * nz * grid.fft_height + n * grid.fft_square, s=grid.shape), reach
        )
        S = _window(irfft2(nz * grid.fft_known - n * grid.fft_height, s=grid.shape), reach)
        enough = least_overlap * len(points) <= N
        safe = np.where(enough, N, 1.0)
        costs[k] = np.where(enough, np.maximum(E - S * S / (safe + height_prior), 0.0) / safe, np.inf)
        overlaps[k] = N / len(points)
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
    ij = np.floor(xy / cell).astype(np.int64)
    inside = ((ij >= 0) & (ij < np.array(shape))).all(axis=1)
    place = ij[inside, 0] * shape[1] + ij[inside, 1]
    size = shape[0] * shape[1]
    total: FloatArray = np.bincount(place, weights=z[inside], minlength=size).astype(np.float64)
    count: FloatArray = np.bincount(place, minlength=size).astype(np.float64)
    return total.reshape(shape), count.reshape(shape)


def _transformed(xy: FloatArray, z: FloatArray, shape: tuple[int, int], cell: float) -> tuple[FloatArray, ...]:
    """Conjugate transforms of count, sum of z and sum of z^2 per cell: multiplied with another's, a correlation."""
    ij = np.floor(xy / cell).astype(np.int64) % np.array(shape)  # a shift wraps round as the transform does
    place = ij[:, 0] * shape[1] + ij[:, 1]
    size = shape[0] * shape[1]
    return tuple(
        np.conj(rfft2(np.bincount(place, weights=w, minlength=size).reshape(shape).astype(np.float64)))
        for w in (np.ones_like(z), z, z * z)
    )


def _window(correlation: FloatArray, reach: NDArray[np.int_]) -> FloatArray:
    """Shifts from -reach to reach along both axes, from the wrapped order of a transform."""
    rows = np.arange(-reach[0], reach[0] + 1)
    columns = np.arange(-reach[1], reach[1] + 1)
    cut: FloatArray = correlation[np.ix_(rows, columns)]
    return cut


def grid_around(low: FloatArray, high: FloatArray, cell: float) -> tuple[FloatArray, tuple[int, int]]:
    """Corner and shape of a grid over a box; shapes that transform fast."""
    cells = np.ceil((high - low) / cell).astype(int) + 1
    return low, (next_fast_len(int(cells[0]), real=True), next_fast_len(int(cells[1]), real=True))
