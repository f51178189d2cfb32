"""What touches of walls say about the pose of their frame: residuals, their slopes by it, and what of it is only noise.

Source: Low, "Linear least-squares optimization for point-to-plane ICP surface registration" (2004), with the planes of
`wall_surface`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.wall_surface import WallSurface

FloatArray = NDArray[np.float64]

X, Y = 0, 1
#: Deviation of headings within a wall, rad: what was mapped turned has a slope along itself. Half of what counts for
#: a floor, as walls themselves tell the heading.
TURN_SIGMA = 0.015


@dataclass(frozen=True, slots=True)
class WallTouches:
    """Touches of walls that are to be fitted onto walls touched before.

    Attributes:
        surface: the walls.
        points: touches in their own frame, level, shape (m, 3), m.
    """

    surface: WallSurface
    points: FloatArray


@dataclass(frozen=True, slots=True)
class WallTerms:
    """What m touches of walls contribute to fits from k poses.

    Attributes:
        known: whether the wall is, shape (k, m).
        residual: of the touches from it, shape (k, m), m.
        jacobian: of the residuals by (x, y, yaw, z), shape (k, 4, m).
        variance: of the residuals, shape (k, m), m2.
        by_slope: derivatives of the jacobian's columns, shape (k, 4, m), by the slope along the wall; the slope up
            has one in z.
        slope_noise: covariance of the slopes, its aa, az and zz, shape (3, k, m).
    """

    known: NDArray[np.bool_]
    residual: FloatArray
    jacobian: FloatArray
    variance: FloatArray
    by_slope: FloatArray
    slope_noise: FloatArray

    def noise_information(self, weight: FloatArray) -> FloatArray:
        """What errors of the walls' slopes add to J' W J in the mean, shape (k, 4, 4).

        Args:
            weight: of the touches, shape (k, m).
        """
        aa, az, zz = self.slope_noise
        added: FloatArray = (self.by_slope * (weight * (aa + TURN_SIGMA**2))[:, None]) @ self.by_slope.transpose(
            0, 2, 1
        )
        by_both = (self.by_slope @ (weight * az)[:, :, None])[:, :, 0]
        added[:, 3] += by_both
        added[:, :, 3] += by_both
        added[:, 3, 3] += (weight * zz).sum(axis=1)
        return added


def wall_terms(surface: WallSurface, q: FloatArray, poses: FloatArray) -> WallTerms:
    """Residuals and derivatives of touches.

    Args:
        surface: the walls.
        q: touches placed by each of the poses, shape (k, m, 3), m.
        poses: of their frame, shape (k, 4).
    """
    patches = surface.at(q.reshape(-1, 3))
    shape = q.shape[:2]
    a_x, a_y = patches.along.reshape(2, *shape)
    g_a, g_z = patches.slope.reshape(2, *shape)
    l_x, l_y = q[:, :, 0] - poses[:, None, X], q[:, :, 1] - poses[:, None, Y]
    by_x, by_y = -a_y - g_a * a_x, a_x - g_a * a_y
    return WallTerms(
        patches.known.reshape(shape),
        patches.residual.reshape(shape),
        np.stack([by_x, by_y, by_y * l_x - by_x * l_y, -g_z], axis=1),
        patches.variance.reshape(shape),
        np.stack([a_x, a_y, a_y * l_x - a_x * l_y, np.zeros(shape)], axis=1),
        patches.slope_noise.reshape(3, *shape),
    )
