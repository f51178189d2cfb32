"""Fits touches onto a touched surface: x, y, yaw and z of one in the other, by their heights.

Each touch has the residual r = z - h(x, y); its slope by the pose comes from the surface's slope. Gauss-Newton with
a Cauchy weight per touch (side contacts, whiskers on whiskers, edges), and a Gaussian prior where there is one. The
information matrix H = J' W J tells which directions the ground constrains: on a flat floor only z. The slopes in J
are estimates, whose errors alone make J' W J look informed; what they add is taken off again.

Sources: Zhang, "Parameter estimation techniques" (1997) for the weights; Censi, "An accurate closed-form estimate of
ICP's covariance" (ICRA 2007) for what H says and what it does not (touches share the errors of their whiskers).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.geometry import wrap_angle
from robominer_slam.slam.surface import Surface, SurfacePatches

FloatArray = NDArray[np.float64]

#: Order of the four unknowns.
X, Y, YAW, Z = range(4)
#: Reweightings for one set of planes: each costs a few small matrix products.
REWEIGHTINGS = 3
#: Width of the Cauchy kernel, in sigmas.
KERNEL_WIDTH = 2.5
#: What noise adds to the information varies about its mean, the more the fewer touches carry it: half as much again.
NOISE_MARGIN = 1.5
#: Deviation of headings within a surface, rad.
TURN_SIGMA = 0.03
#: Residuals under this many sigmas count as fitting.
INLIER_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class SurfaceMatch:
    """Where touches fit onto a surface.

    Attributes:
        pose: x, y (m), yaw (rad), z (m) of the touches' frame in the surface's, shape (4,).
        information: H at the pose, prior left out, the slopes' errors taken off, shape (4, 4); positive
            semidefinite.
        curvature: J' W J itself, shape (4, 4).
        gradient: J' W r at the pose, prior left out, shape (4,): where the touches alone would pull.
        overlap: share of the touches that lie where the surface is known.
        inliers: share of those whose residual is within three sigmas.
        rms: of the inliers' residuals, m.
        cost: mean squared residual, each at most three sigmas, m2: what places are compared by.
        heights: of the surface under the touches on it, with their x and y: shape (k, 3), m.
    """

    pose: FloatArray
    information: FloatArray
    curvature: FloatArray
    gradient: FloatArray
    overlap: float
    inliers: float
    rms: float
    cost: float
    heights: FloatArray

    @property
    def relief(self) -> float:
        """Standard deviation of the surface's heights under the touches, its common tilt left out, m."""
        if len(self.heights) < 4:
            return 0.0
        plane = np.column_stack([np.ones(len(self.heights)), self.heights[:, :2] - self.heights[:, :2].mean(axis=0)])
        tilt, *_ = np.linalg.lstsq(plane, self.heights[:, 2], rcond=None)
        return float(np.std(self.heights[:, 2] - plane @ tilt))


def placed(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Points (m, 3) of a frame at `pose` (x, y, yaw, z) in the other frame, m."""
    c, s = np.cos(pose[YAW]), np.sin(pose[YAW])
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([c * x - s * y + pose[X], s * x + c * y + pose[Y], points[:, 2] + pose[Z]])


def residual_jacobian(q: FloatArray, pose: FloatArray, slope: FloatArray) -> FloatArray:
    """Derivative (m, 4) of z - h(x, y) by (x, y, yaw, z), for touches at q (m, 3) on a surface of `slope` (m, 2)."""
    J = np.empty((len(q), 4))
    J[:, :2] = -slope
    J[:, YAW] = slope[:, 0] * (q[:, 1] - pose[Y]) - slope[:, 1] * (q[:, 0] - pose[X])
    J[:, Z] = 1.0
    return J


def fit(
    surface: Surface,
    points: FloatArray,
    guess: FloatArray,
    prior_information: FloatArray,
    associations: int = 2,
) -> SurfaceMatch:
    """Fit touches onto a surface.

    Args:
        surface: what was touched before.
        points: touches in their own frame, level, shape (m, 3), m.
        guess: first pose and mean of the prior, shape (4,).
        prior_information: of the prior, shape (4, 4); zeros for none, but then the touches must constrain the pose
            or the step is only as long as they say.
        associations: how often planes are looked up; once suffices where the guess is good to millimetres.
    """
    pose = guess.copy()
    H, gradient = np.zeros((4, 4)), np.zeros(4)
    regular = prior_information + np.eye(4) * 1e-9
    for _ in range(associations):
        q = placed(points, pose)
        patches = surface.at(q[:, :2])
        known = patches.known
        if int(known.sum()) < 4:
            nothing = np.zeros((4, 4))
            return SurfaceMatch(
                pose, nothing, nothing, np.zeros(4), float(known.mean()), 0.0, 0.0, np.inf, np.zeros((0, 3))
            )
        r = q[known, 2] - patches.height[known]
        J = residual_jacobian(q[known], pose, patches.slope[known])
        inverse_variance = 1.0 / patches.variance[known]
        offset = pose - guess
        offset[YAW] = wrap_angle(offset[YAW])
        step = np.zeros(4)
        for _ in range(REWEIGHTINGS):
            e = r + J @ step
            weight = inverse_variance / (1.0 + e * e * inverse_variance / KERNEL_WIDTH**2)
            JtW = J.T * weight
            H = JtW @ J
            step = np.linalg.solve(H + regular, -JtW @ r - prior_information @ offset)
        gradient = JtW @ (r + J @ step)
        pose = pose + step
    slope_noise = patches.slope_noise[known] + turned_slope_noise(patches.slope[known])
    noise = slope_noise_information(q[known], pose, slope_noise, weight)
    return _judged(pose, (_less(H, noise), H), gradient, patches, q, r + J @ step)


def height_left_free(H: FloatArray) -> FloatArray:
    """Information about (x, y, yaw), shape (3, 3), of one about (x, y, yaw, z): the Schur complement of z."""
    planar: FloatArray = H[:3, :3] - np.outer(H[:3, Z], H[Z, :3]) / max(float(H[Z, Z]), 1e-12)
    return planar


def turned_slope_noise(slope: FloatArray) -> FloatArray:
    """Covariance (m, 2, 2) of slopes (m, 2) by headings that were a little off when the surface was touched.

    A ridge that was mapped slightly turned has a slope along itself, and would tell a place along it.
    """
    across = np.column_stack([-slope[:, 1], slope[:, 0]]) * TURN_SIGMA
    return across[:, :, None] * across[:, None, :]


def slope_noise_information(q: FloatArray, pose: FloatArray, slope_noise: FloatArray, weight: FloatArray) -> FloatArray:
    """What errors of the slopes add to J' W J in the mean, shape (4, 4).

    Args:
        q: touches on the surface, shape (m, 3), m.
        pose: of their frame, shape (4,).
        slope_noise: covariance of the slopes there, shape (m, 2, 2).
        weight: of the touches, shape (m,).
    """
    M = np.zeros((len(q), 2, 3))  # J = slope M
    M[:, 0, X] = M[:, 1, Y] = -1.0
    M[:, 0, YAW], M[:, 1, YAW] = q[:, 1] - pose[Y], pose[X] - q[:, 0]
    added = np.zeros((4, 4))
    added[:3, :3] = np.einsum("m,mia,mij,mjb->ab", weight, M, slope_noise, M)
    return added


def _less(H: FloatArray, noise: FloatArray) -> FloatArray:
    """H without what noise adds, and somewhat more, as that is a mean; kept positive semidefinite."""
    values, vectors = np.linalg.eigh(H)
    kept = np.einsum("ia,ij,ja->a", vectors, noise, vectors)
    share = np.clip(1.0 - NOISE_MARGIN * kept / np.maximum(values, 1e-12), 0.0, 1.0)
    return np.asarray((vectors * (values * share)) @ vectors.T)


def _judged(
    pose: FloatArray,
    H: tuple[FloatArray, FloatArray],
    gradient: FloatArray,
    patches: SurfacePatches,
    q: FloatArray,
    residual: FloatArray,
) -> SurfaceMatch:
    known = patches.known
    limit = INLIER_SIGMAS * np.sqrt(patches.variance[known])
    fits = np.abs(residual) < limit
    cost = float(np.mean(np.minimum(residual**2, limit**2)))
    rms = float(np.sqrt(np.mean(residual[fits] ** 2))) if fits.any() else 0.0
    heights = np.column_stack([q[known, :2], patches.height[known]])
    return SurfaceMatch(pose, *H, gradient, float(known.mean()), float(fits.mean()), rms, cost, heights)
