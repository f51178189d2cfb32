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
#: Touches in a leaf of the search tree: more of them make it sooner built, and searched as fast.
LEAF = 24
#: Of a plane: so many of the residuals go into the fit itself.
UNKNOWNS = 3
#: Symmetric matrices (3, 3) are kept as six entries, row by row from the diagonal on: where the diagonal is, and where
#: each entry of the whole is. A cofactor is the product of the first and second less that of the third and fourth.
DIAGONAL = [0, 3, 5]
WHOLE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
FIRST, SECOND = np.array([3, 4, 1, 0, 1, 0]), np.array([5, 2, 4, 5, 2, 3])
THIRD, FOURTH = np.array([4, 1, 2, 2, 0, 1]), np.array([4, 5, 3, 2, 4, 1])
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
        self._tree = cKDTree(points[:, :2], LEAF, balanced_tree=False, compact_nodes=False) if len(points) else None
        # And one more: where the search finds too few touches, it tells an index past the end.
        self._rows = np.zeros((len(points) + 1, 3))
        self._rows[:-1] = points

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
        offset = np.ascontiguousarray(self._rows.take(np.transpose(index), axis=0).transpose(2, 0, 1))
        offset[:2] -= xy.T[:, None]
        return planes_through(offset, squared, model)


def planes_through(offset: FloatArray, squared: FloatArray, model: SurfaceModel) -> SurfacePatches:
    """Planes through the touches around m places.

    Args:
        offset: along both axes of the surface from a place to its k nearest touches, nearest first, and their
            heights, shape (3, k, m), m; is used up.
        squared: of their distances along the surface, shape (k, m), m2; infinite for those that are missing.
        model: how touches make a surface.
    """
    m = squared.shape[1]
    prior = 1.0 / model.slope_sigma**2
    count = (squared < np.inf).sum(axis=0, dtype=np.int8)
    weight = 1.0 / (model.touch_sigma**2 + np.square(model.curvature * squared))
    # Heights are taken relative to the nearest touch: the regression's numbers stay small.
    datum = offset[2, 0].copy()
    offset[2] -= datum
    weighted = offset * weight
    # The normal equations' matrix and its right side, of height and slopes along x and y.
    M, right_side = np.empty((6, m)), np.empty((3, m))
    weight.sum(axis=0, out=M[0])
    weighted[:2].sum(axis=1, out=M[1:3])
    weighted[2].sum(axis=0, out=right_side[0])
    M[3], M[4], right_side[1] = np.einsum("km,akm->am", weighted[0], offset)
    M[5], right_side[2] = np.einsum("km,akm->am", weighted[1], offset[1:])
    zz = np.einsum("km,km->m", weighted[2], offset[2])
    prior_of = np.array([[1e-6 / model.touch_sigma**2], [prior], [prior]])
    M[DIAGONAL] += prior_of
    # Its inverse by cofactors.
    inverse = M.take(FIRST, axis=0) * M.take(SECOND, axis=0)
    inverse -= M.take(THIRD, axis=0) * M.take(FOURTH, axis=0)
    inverse /= np.einsum("am,am->m", M[:3], inverse[:3])
    plane = np.einsum("abm,bm->am", inverse.take(WHOLE, axis=0), right_side)
    # What the plane f leaves of the weighted squares: z'Wz - f'X'Wz, without what the prior pulls f by.
    chi2 = zz - np.einsum("am,am->m", plane, right_side + prior_of * plane)
    np.maximum(chi2, 0.0, out=chi2)
    height, slope, slope_covariance = plane[0], np.ascontiguousarray(plane[1:].T), inverse[3:]
    known = count >= LEAST_NEIGHBOURS
    # A step must show here, four touches that are off their plane by chance must not: the mean over the touches.
    steps = np.maximum(chi2 / np.maximum(count - 1, 1), 1.0)
    variance = inverse[0] * steps + model.touch_sigma**2
    misfit = chi2 / np.maximum(count - UNKNOWNS, 1)
    return SurfacePatches(known, np.where(known, datum + height, 0.0), slope, variance, slope_covariance, misfit, prior)
