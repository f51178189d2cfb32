"""A known map's touches, prepared once: as a surface to fit onto, and as a grid to search."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.composite_scan import voxel_filter
from robominer_slam.slam.global_search import GlobalSearch
from robominer_slam.slam.surface import Surface, SurfaceModel
from robominer_slam.slam.surface_registration import placed

FloatArray = NDArray[np.float64]

#: Share of touches in a likelihood that come from anywhere: side contacts, whiskers on whiskers, edges.
OUTLIERS = 0.1
#: Range of heights that those come from, m.
OUTLIER_RANGE = 0.2
#: Least deviation of heights about their mean that a patch is compared with, m.
LEAST_RELIEF = 0.004


class MapGround:
    """What was touched in a map.

    Args:
        touches: in map, shape (n, 3), m.
        model: how touches make a surface.
        voxel: touches closer than this are one, m.
        cell, reach: see `GlobalSearch`.
    """

    def __init__(self, touches: FloatArray, model: SurfaceModel, voxel: float, cell: float, reach: float) -> None:
        self.touches = voxel_filter(touches, voxel)
        self.surface = Surface(self.touches, model)
        self.search = GlobalSearch(self.touches, cell, reach)

    def log_odds(self, points: FloatArray, pose: FloatArray) -> float:
        """Log-likelihood of touches at a pose, over that of touches on ground that nobody has mapped.

        Unmapped ground is as rough as the patch itself; touches where the map knows nothing say nothing.

        Args:
            points: in their own frame, shape (m, 3), m.
            pose: x, y, yaw, z of it in map, shape (4,).
        """
        q = placed(points, pose)
        patches = self.surface.at(q[:, :2])
        known = patches.known
        residual = q[known, 2] - patches.height[known]
        variance = patches.variance[known]
        relief = points[:, 2] - points[:, 2].mean()
        free = float(relief.var()) + LEAST_RELIEF**2
        fits = np.exp(-0.5 * residual**2 / variance) / np.sqrt(2.0 * np.pi * variance)
        mapped = np.log((1.0 - OUTLIERS) * fits + OUTLIERS / OUTLIER_RANGE)
        unmapped = -0.5 * relief[known] ** 2 / free - 0.5 * np.log(2.0 * np.pi * free)
        return float((mapped - unmapped).sum())
