"""The touched surface as heights over the plane: a plane fitted to the touches around any place.

Whiskers touch along lines, some centimetres apart, and the ground bends between them. So the height at a place is a
Bayesian regression z = a + g . d over the nearest touches at offsets d, with a prior on the slope g: between the
lines of touches, where the data leave the slope across them free, the prior keeps it small and the variance says
so. The variance is what a match is weighed with: near a step the touches do not lie in one plane, the misfit is
large, and the place counts for little.

Sources: Bishop, "Pattern recognition and machine learning" (2006), section 3.3 (Bayesian linear regression).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robominer_slam.configuration.robust_slam_section import SurfaceSection

FloatArray = NDArray[np.float64]

#: Touches that make up the surface at one place, at most and at least.
NEIGHBOURS = 10
LEAST_NEIGHBOURS = 4
#: Of a plane: so many of the residuals go into the fit itself.
UNKNOWNS = 3
#: A few touches may lie in a plane by chance: their misfit, in variances, counts as no less.
LEAST_MISFIT = 0.1


@dataclass(frozen=True, slots=True)
class SurfaceModel:
    """How touches relate to the surface.

    Attributes:
        touch_sigma: of a touch's height after calibration, m.
        curvature: by how much the ground leaves its tangent plane, as d^2 times this, 1/m.
        slope_sigma: of the ground's slope, 1.
        reach: touches farther than this say nothing about a place, m.
    """

    touch_sigma: float
    curvature: float
    slope_sigma: float
    reach: float

    @classmethod
    def of(cls, section: SurfaceSection) -> SurfaceModel:
        """As configured."""
        return cls(section.touch_sigma, section.curvature, section.slope_sigma, section.reach)


@dataclass(frozen=True, slots=True)
class SurfacePatches:
    """The surface at m places.

    Attributes:
        known: whether there are touches enough around it, shape (m,).
        height: shape (m,), m; 0 where it is not known.
        slope: dz/dx, dz/dy, shape (m, 2).
        variance: of a new touch's height there, shape (m,), m2.
        slope_covariance: of the slope as the regression says it, its xx, xy and yy, shape (3, m).
        misfit: of the touches to their plane, in variances, shape (m,).
        prior_information: of the slope's prior, 1.
    """

    known: NDArray[np.bool_]
    height: FloatArray
    slope: FloatArray
    variance: FloatArray
    slope_covariance: FloatArray
    misfit: FloatArray
    prior_information: float

    @property
    def slope_noise(self) -> FloatArray:
        """Covariance of the slope by the touches' errors, its xx, xy and yy, shape (3, m): what of it is no ground.

        The estimate is C X'W z: errors of z with covariance W^-1 reach it as C X'WX C = C - C prior C.
        """
        xx, xy, yy = self.slope_covariance
        noise = np.empty_like(self.slope_covariance)
        noise[0] = xx * xx + xy * xy
        noise[1] = xy * (xx + yy)
        noise[2] = xy * xy + yy * yy
        noise *= -self.prior_information
        noise += self.slope_covariance
        noise *= np.maximum(self.misfit, LEAST_MISFIT)
        return noise


class Surface:
    """Touches with a search tree over their x and y.

    Args:
        points: shape (n, 3), m.
        model: how they relate to the surface.
    """

    def __init__(self, points: FloatArray, model: SurfaceModel) -> None:
        self.points = points
        self._model = model
        self._tree = cKDTree(points[:, :2], balanced_tree=False, compact_nodes=False) if len(points) else None
        # By coordinates, and one more: where the search finds too few touches, it tells an index past the end.
        self._columns = np.zeros((3, len(points) + 1))
        self._columns[:, :-1] = points.T

    def __len__(self) -> int:
        return len(self.points)

    def at(self, xy: FloatArray) -> SurfacePatches:
        """The surface at places of shape (m, 2), m."""
        m = len(xy)
        model = self._model
        prior = 1.0 / model.slope_sigma**2
        if self._tree is None or len(self.points) < LEAST_NEIGHBOURS or m == 0:
            nothing = np.zeros((3, m)), np.zeros(m), prior
            return SurfacePatches(np.zeros(m, dtype=np.bool_), np.zeros(m), np.zeros((m, 2)), np.ones(m), *nothing)
        distance, index = self._tree.query(xy, k=NEIGHBOURS, distance_upper_bound=model.reach)
        # Neighbours along the first axis: sums over them then run along whole rows of places. Those missing are
        # infinitely far and weigh nothing.
        squared = np.ascontiguousarray(np.transpose(distance)) ** 2
        count = (squared < np.inf).sum(axis=0, dtype=np.int8)
        weight = 1.0 / (model.touch_sigma**2 + np.square(model.curvature * squared))
        offset = self._columns.take(np.transpose(index), axis=1)
        # Heights are taken relative to the nearest touch: the regression's numbers stay small.
        datum = offset[2, 0].copy()
        offset[:2] -= xy.T[:, None]
        offset[2] -= datum
        weighted = offset[:2] * weight
        s_x, s_y = weighted.sum(axis=1)
        xx, xy_, xz = np.einsum("km,akm->am", weighted[0], offset)
        yy, yz = np.einsum("km,akm->am", weighted[1], offset[1:])
        weighted_z = weight * offset[2]
        s_z = weighted_z.sum(axis=0)
        zz = np.einsum("km,km->m", weighted_z, offset[2])
        # The normal equations' matrix with the prior in it, and its inverse by cofactors.
        height_prior = 1e-6 / model.touch_sigma**2
        s = weight.sum(axis=0) + height_prior
        xx += prior
        yy += prior
        c_0 = xx * yy - xy_ * xy_
        c_x = xy_ * s_y - s_x * yy
        c_y = s_x * xy_ - s_y * xx
        by_determinant = 1.0 / (s * c_0 + s_x * c_x + s_y * c_y)
        slope_covariance = np.empty((3, m))
        slope_covariance[0] = s * yy - s_y * s_y
        slope_covariance[1] = s_x * s_y - s * xy_
        slope_covariance[2] = s * xx - s_x * s_x
        slope_covariance *= by_determinant
        c_0, c_x, c_y = c_0 * by_determinant, c_x * by_determinant, c_y * by_determinant
        height = c_0 * s_z + c_x * xz + c_y * yz
        slope = np.empty((m, 2))
        slope[:, 0] = c_x * s_z + slope_covariance[0] * xz + slope_covariance[1] * yz
        slope[:, 1] = c_y * s_z + slope_covariance[1] * xz + slope_covariance[2] * yz
        # What the plane f leaves of the weighted squares: z'Wz - f'X'Wz, without what the prior pulls f by.
        chi2 = zz - height * (s_z + height_prior * height)
        chi2 -= slope[:, 0] * (xz + prior * slope[:, 0]) + slope[:, 1] * (yz + prior * slope[:, 1])
        np.maximum(chi2, 0.0, out=chi2)
        known = count >= LEAST_NEIGHBOURS
        # A step must show here, four touches that are off their plane by chance must not: the mean over the touches.
        steps = np.maximum(chi2 / np.maximum(count - 1, 1), 1.0)
        variance = c_0 * steps + model.touch_sigma**2
        misfit = chi2 / np.maximum(count - UNKNOWNS, 1)
        return SurfacePatches(
            known, np.where(known, datum + height, 0.0), slope, variance, slope_covariance, misfit, prior
        )
