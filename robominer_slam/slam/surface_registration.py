"""Fits touches onto a touched surface: x, y, yaw and z of one in the other, by their heights.

Each touch has the residual r = z - h(x, y); its slope by the pose comes from the surface's slope. Gauss-Newton with
a Cauchy weight per touch (side contacts, whiskers on whiskers, edges), and a Gaussian prior where there is one. The
information matrix H = J' W J tells which directions the ground constrains: on a flat floor only z. The slopes in J
are estimates, whose errors alone make J' W J look informed; what they add is taken off again.

Sources: Zhang, "Parameter estimation techniques" (1997) for the weights; Censi, "An accurate closed-form estimate of
ICP's covariance" (ICRA 2007) for what H says and what it does not (touches share the errors of their whiskers).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.float_array import of_floats
from robominer_slam.geometry import wrap_angle
from robominer_slam.slam.slope_noise import less, slope_noise_information, turned_slope_noise
from robominer_slam.slam.surface import Surface
from robominer_slam.slam.wall_registration import WallTouches, wall_terms

FloatArray = NDArray[np.float64]

#: Order of the four unknowns.
X, Y, YAW, Z = range(4)
#: Reweightings for one set of planes: each costs a few small matrix products.
REWEIGHTINGS = 3
#: Width of the Cauchy kernel, in sigmas.
KERNEL_WIDTH = 2.5
#: Of the touches, every so manieth shows which guesses are on the way to the same place.
COARSE = 2
#: Touches on known ground that a match takes at least: as many as it has unknowns.
LEAST_KNOWN = 4
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
    x, y, yaw, z = pose.tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    # Points are rows: the rotation is its transpose.
    q: FloatArray = points.dot(of_floats([c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0]).reshape(3, 3))
    q += of_floats([x, y, z])
    return q


def residual_jacobian(q: FloatArray, pose: FloatArray, slope: FloatArray) -> FloatArray:
    """Derivatives of z - h(x, y) by (x, y, yaw, z), shape (..., 4, m): a row for each of the four.

    Args:
        q: touches on the surface, shape (..., m, 3), m.
        pose: of their frame, shape (..., 4).
        slope: of the surface there, shape (..., m, 2).
    """
    J = np.empty((*slope.shape[:-2], 4, slope.shape[-2]))
    along_x, along_y = slope[..., 0], slope[..., 1]
    np.negative(along_x, out=J[..., X, :])
    np.negative(along_y, out=J[..., Y, :])
    J[..., YAW, :] = along_x * (q[..., 1] - pose[..., Y, None]) - along_y * (q[..., 0] - pose[..., X, None])
    J[..., Z, :] = 1.0
    return J


def fit(
    surface: Surface,
    points: FloatArray,
    guess: FloatArray,
    prior_information: FloatArray,
    associations: int = 2,
    walls: WallTouches | None = None,
) -> SurfaceMatch:
    """Fit touches onto a surface.

    Args:
        surface: what was touched before.
        points: touches in their own frame, level, shape (m, 3), m.
        guess: first pose and mean of the prior, shape (4,).
        prior_information: of the prior, shape (4, 4); zeros for none, but then the touches must constrain the pose
            or the step is only as long as they say.
        associations: how often planes are looked up; once suffices where the guess is good to millimetres.
        walls: touches of walls in the same frame, and the walls that they are fitted onto.
    """
    return fit_each(surface, points, guess[None], prior_information, associations, walls=walls)[0]


def fit_each(
    surface: Surface,
    points: FloatArray,
    guesses: FloatArray,
    prior_information: FloatArray,
    associations: int = 2,
    apart: tuple[float, float] | None = None,
    walls: WallTouches | None = None,
) -> list[SurfaceMatch]:
    """As `fit`, from each of several guesses, shape (k, 4): together they cost less than one after the other.

    Touches where the surface is not known weigh nothing.

    Args:
        surface, points, guesses, prior_information, associations: as of `fit`.
        apart: guesses that come as near to one of less cost, m and rad, are on the way to the same place: they are
            not followed, and have no match, unless one of all gets lost. Up to the last look at the planes half of
            the touches will do. None follows all of them, with all touches.
        walls: as of `fit`.
    """
    poses = guesses.copy()
    regular = prior_information + np.eye(4) * 1e-9
    pull = np.zeros((len(poses), 4, 1))
    for again in range(associations):
        last = again == associations - 1
        every = 1 if apart is None or last else COARSE
        some = points[::every]
        # Columns of touches: the floor's, then the walls'.
        floor = len(some)
        some = some if walls is None else np.concatenate([some, walls.points[::every]])
        q = np.empty((len(poses), *some.shape))
        for k, pose in enumerate(poses):
            q[k] = placed(some, pose)
        on_floor = q[:, :floor]
        patches = surface.at(on_floor.reshape(-1, 3)[:, :2])
        known, variance = patches.known.reshape(len(poses), -1), patches.variance.reshape(len(poses), -1)
        r = np.where(known, on_floor[:, :, 2] - patches.height.reshape(known.shape), 0.0)
        J = residual_jacobian(on_floor, poses, patches.slope.reshape(*known.shape, 2))
        if walls is not None:
            terms = wall_terms(walls.surface, q[:, floor:], poses)
            known, variance = np.hstack([known, terms.known]), np.hstack([variance, terms.variance])
            r, J = np.hstack([r, terms.residual]), np.concatenate([J, terms.jacobian], axis=2)
        if min(map(np.count_nonzero, known)) < LEAST_KNOWN:
            return _without_lost(surface, points, guesses, prior_information, associations, walls, poses, known)
        inverse_variance = known / variance
        by_kernel = inverse_variance / KERNEL_WIDTH**2
        if again:
            offset = poses - guesses
            offset[:, YAW] = wrap_angle(offset[:, YAW])
            pull = (offset @ prior_information)[:, :, None]
        e = r
        for _ in range(REWEIGHTINGS):
            weight = inverse_variance / (1.0 + e * e * by_kernel)
            JtW = J * weight[:, None]
            H = JtW @ J.transpose(0, 2, 1)
            right_side = JtW @ r[:, :, None] + pull
            step = -np.linalg.solve(H + regular, right_side)[:, :, 0]
            e = r + (step[:, None] @ J)[:, 0]
        gradient = (JtW @ e[:, :, None])[:, :, 0]
        poses = poses + step
        if apart is not None and len(poses) > 1 and not last:
            squared, limit = np.square(e), INLIER_SIGMAS**2 * variance
            costs = (np.minimum(squared, limit) * known).sum(axis=1) / known.sum(axis=1)
            followed = _distinct(poses, costs, *apart)
            poses, guesses, pull = poses[followed], guesses[followed], pull[followed]
    slope_noise = patches.slope_noise + turned_slope_noise(patches.slope)
    height = patches.height.reshape(len(poses), -1)
    noise = slope_noise_information(on_floor, poses, slope_noise.reshape(3, *height.shape), weight[:, :floor])
    if walls is None:
        information = less(H, noise)
    else:
        # Each on its own: a floor whose slopes are all errors must not take away what walls know.
        by_walls = JtW[:, :, floor:] @ J[:, :, floor:].transpose(0, 2, 1)
        information = less(H - by_walls, noise) + less(by_walls, terms.noise_information(weight[:, floor:]))
    return [
        _judged(poses[k], (information[k], H[k]), gradient[k], known[k], variance[k], height[k], q[k], e[k])
        for k in range(len(poses))
    ]


def _without_lost(
    surface: Surface,
    points: FloatArray,
    guesses: FloatArray,
    prior_information: FloatArray,
    associations: int,
    walls: WallTouches | None,
    poses: FloatArray,
    known: NDArray[np.bool_],
) -> list[SurfaceMatch]:
    """Matches of guesses of which some, at `poses` by now, have left the known ground: the others go on alone."""
    lost = known.sum(axis=1) < LEAST_KNOWN
    nothing = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros(4)
    on = guesses[~lost]
    left = iter(fit_each(surface, points, on, prior_information, associations, None, walls) if len(on) else ())
    return [
        SurfaceMatch(pose, *nothing, float(on.mean()), 0.0, 0.0, np.inf, np.zeros((0, 3))) if gone else next(left)
        for pose, on, gone in zip(poses, known, lost, strict=True)
    ]


def _distinct(poses: FloatArray, costs: FloatArray, distance: float, angle: float) -> list[int]:
    """Rows of the poses (k, 4), growing, that are not within a distance, m, and an angle, rad, of one of less cost."""
    kept: list[int] = []
    for row in np.argsort(costs, kind="stable").tolist():
        off = poses[kept] - poses[row]
        near = (np.hypot(off[:, X], off[:, Y]) <= distance) & (np.abs(wrap_angle(off[:, YAW])) <= angle)
        if not near.any():
            kept.append(row)
    return sorted(kept)


def height_left_free(H: FloatArray) -> FloatArray:
    """Information about (x, y, yaw), shape (3, 3), of one about (x, y, yaw, z): the Schur complement of z."""
    along_z = H[:3, Z]
    planar: FloatArray = H[:3, :3] - along_z[:, None] * (along_z / max(float(H[Z, Z]), 1e-12))
    return planar


def _judged(
    pose: FloatArray,
    H: tuple[FloatArray, FloatArray],
    gradient: FloatArray,
    known: NDArray[np.bool_],
    variance: FloatArray,
    height: FloatArray,
    q: FloatArray,
    residual: FloatArray,
) -> SurfaceMatch:
    on = np.flatnonzero(known)
    squared, limit = np.square(residual[on]), INLIER_SIGMAS**2 * variance[on]
    fits = squared < limit
    count = int(np.count_nonzero(fits))
    cost = float(np.minimum(squared, limit).sum()) / len(on)
    rms = math.sqrt(float(squared @ fits) / count) if count else 0.0
    on_floor = on[: int(np.searchsorted(on, len(height)))]
    heights = np.empty((len(on_floor), 3))
    heights[:, :2], heights[:, 2] = q[on_floor, :2], height[on_floor]
    return SurfaceMatch(pose, *H, gradient, len(on) / len(known), count / len(on), rms, cost, heights)
