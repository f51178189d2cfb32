"""The final map against the true surface, cell by cell, where whiskers can know it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
#: Height of the true surface at places x, y of equal shape in map, m.
HeightFunction = Callable[[FloatArray, FloatArray], FloatArray]

CELL_M = 0.02
MAX_SLOPE_DEG = 30.0
STEP_CLEARANCE_M = 0.03
#: The true surface is sampled this finely to find slopes and steps, m.
SAMPLING_M = 0.005
#: Steeper than this between two samples is a step, not a slope: the side of a box, the rim of a sphere.
STEP_SLOPE_DEG = 60.0
#: Cells looked at together: bounds the memory.
CHUNK = 2000


@dataclass(frozen=True, slots=True)
class HeightErrors:
    """Errors of the map's heights after one constant offset in z was removed.

    Attributes:
        cells: cells compared.
        touched: cells touched, steep ones and those near a step included.
        offset_m: the offset: the median of map minus truth.
        rms_m: root mean square of the cells' errors.
        median_m: median of their absolute values.
        p95_m: 95 % quantile of their absolute values.
    """

    cells: int
    touched: int
    offset_m: float
    rms_m: float
    median_m: float
    p95_m: float

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


def height_errors(points: FloatArray, height: HeightFunction, cell: float = CELL_M) -> HeightErrors | None:
    """Compare a map's points with the true surface.

    A cell's error is the mean over its points of z minus the surface's height at the same x and y. Cells count whose
    surface slopes by less than 30 deg and lies more than 3 cm from a step.

    Args:
        points: of the map, shape (m, 3), m.
        height: the true surface.
        cell: size, m.

    Returns:
        None where no cell can be compared.
    """
    if not len(points):
        return None
    ij = np.floor(points[:, :2] / cell).astype(np.int64)
    cells, index = np.unique(ij, axis=0, return_inverse=True)
    index = index.reshape(-1)
    residual = points[:, 2] - height(points[:, 0], points[:, 1])
    mean = np.bincount(index, weights=residual) / np.bincount(index)
    errors = mean[gentle(cells, height, cell)]
    if not len(errors):
        return None
    offset = float(np.median(errors))
    absolute = np.abs(errors - offset)
    return HeightErrors(
        len(errors),
        len(cells),
        offset,
        float(np.sqrt(np.mean(absolute**2))),
        float(np.median(absolute)),
        float(np.percentile(absolute, 95)),
    )


def gentle(cells: NDArray[np.int64], height: HeightFunction, cell: float) -> NDArray[np.bool_]:
    """Which cells' centres slope by less than 30 deg and lie over 3 cm from a step; cells (i, j) of shape (n, 2)."""
    reach = round(STEP_CLEARANCE_M / SAMPLING_M)
    around = SAMPLING_M * np.arange(-reach, reach + 1)
    v, u = np.meshgrid(around, around, indexing="ij")
    steep = SAMPLING_M * np.tan(np.deg2rad(STEP_SLOPE_DEG))
    result = np.zeros(len(cells), dtype=np.bool_)
    for start in range(0, len(cells), CHUNK):
        centre = (cells[start : start + CHUNK] + 0.5) * cell
        z = height(centre[:, 0, None, None] + u, centre[:, 1, None, None] + v)
        jump = np.maximum(
            np.abs(np.diff(z, axis=1)).max(axis=(1, 2)),
            np.abs(np.diff(z, axis=2)).max(axis=(1, 2)),
        )
        dy = (z[:, reach + 1, reach] - z[:, reach - 1, reach]) / (2.0 * SAMPLING_M)
        dx = (z[:, reach, reach + 1] - z[:, reach, reach - 1]) / (2.0 * SAMPLING_M)
        slope = np.hypot(dx, dy)
        result[start : start + CHUNK] = (jump < steep) & (slope < np.tan(np.deg2rad(MAX_SLOPE_DEG)))
    return result
