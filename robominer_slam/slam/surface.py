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
        slope_noise: covariance of the slope by the touches' errors, shape (m, 2, 2): what of it is no ground.
    """

    known: NDArray[np.bool_]
    height: FloatArray
    slope: FloatArray
    variance: FloatArray
    slope_noise: FloatArray


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

    def __len__(self) -> int:
        return len(self.points)

    def at(self, xy: FloatArray) -> SurfacePatches:
        """The surface at places of shape (m, 2), m."""
        m = len(xy)
        if self._tree is None or len(self.points) < LEAST_NEIGHBOURS or m == 0:
            none = np.zeros((m, 2, 2))
            return SurfacePatches(np.zeros(m, dtype=np.bool_), np.zeros(m), np.zeros((m, 2)), np.ones(m), none)
        model = self._model
        distance, index = self._tree.query(xy, k=NEIGHBOURS, distance_upper_bound=model.reach)
        near = index < len(self.points)
        neighbours = self.points[np.where(near, index, 0)]
        squared = np.where(near, distance, 0.0) ** 2
        weight = near / (model.touch_sigma**2 + (model.curvature * squared) ** 2)
        # Heights are taken relative to the nearest touch: the regression's numbers stay small.
        datum = neighbours[:, 0, 2]
        z = neighbours[:, :, 2] - datum[:, None]
        X = np.empty((m, NEIGHBOURS, 3))
        X[:, :, 0] = 1.0
        X[:, :, 1:] = neighbours[:, :, :2] - xy[:, None]
        XtW = (X * weight[:, :, None]).transpose(0, 2, 1)
        A = XtW @ X
        A[:, 0, 0] += 1e-6 / model.touch_sigma**2
        A[:, [1, 2], [1, 2]] += 1.0 / model.slope_sigma**2
        covariance = np.linalg.inv(A)
        fitted = (covariance @ (XtW @ z[:, :, None]))[:, :, 0]
        residual = z - (X @ fitted[:, :, None])[:, :, 0]
        count = near.sum(axis=1)
        chi2 = (weight * residual**2).sum(axis=1)
        known = count >= LEAST_NEIGHBOURS
        # A step must show here, four touches that are off their plane by chance must not: the mean over the touches.
        steps = np.maximum(chi2 / np.maximum(count - 1, 1), 1.0)
        variance = covariance[:, 0, 0] * steps + model.touch_sigma**2
        # The estimate is C X'W z: errors of z with covariance W^-1 reach it as C X'WX C = C - C prior C.
        by_slope = covariance[:, 1:, 1:]
        slope_noise = by_slope - (by_slope @ by_slope) / model.slope_sigma**2
        misfit = chi2 / np.maximum(count - UNKNOWNS, 1)
        slope_noise *= np.maximum(misfit, LEAST_MISFIT)[:, None, None]
        height = np.where(known, datum + fitted[:, 0], 0.0)
        return SurfacePatches(known, height, fitted[:, 1:], variance, slope_noise)
