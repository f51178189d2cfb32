"""Looks for one keyframe's place on ground touched long before: where, how surely, and whether nowhere else.

The target is a pass: keyframes of one earlier drive over this ground, merged into one surface, since small patches
fit falsely in many places. The search covers the whole uncertainty of the prediction at once (`correlative_search`);
its best place is refined (`surface_registration`), and judged: overlap, residuals, contrast of the ground, distance
in cost to the next best place, and whether every direction is constrained. No figure of these depends on the world.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.robust_slam_section import ClosureSection
from robominer_slam.slam.composite_scan import voxel_filter
from robominer_slam.slam.correlative_search import (
    SAME_ANGLE,
    SAME_DISTANCE,
    SearchGrid,
    grid_within,
    headings,
    search,
    turned,
)
from robominer_slam.slam.patch import Patch
from robominer_slam.slam.surface import Surface, SurfaceModel
from robominer_slam.slam.surface_registration import YAW, SurfaceMatch, X, Y, Z, fit_each, height_left_free, placed
from robominer_slam.slam.wall_registration import WallTouches
from robominer_slam.slam.wall_surface import WallSurface

FloatArray = NDArray[np.float64]

#: Deviation of the common height in a match, m: odometry knows it better than any search must.
HEIGHT_SIGMA = 0.01
#: Touches of walls nearer than this are one, m: a mean knows a wall's slope better than those that scatter.
WALL_VOXEL = 0.02
#: Times that planes are looked up anew in the refinement.
ASSOCIATIONS = 3
#: Places of a search that are refined and compared.
ALTERNATIVES = 3
#: Places that come within half of what makes two of them one, m and rad, are refined as one: most do.
APART = 0.5 * SAME_DISTANCE, 0.5 * SAME_ANGLE
#: A refined place may lie so far outside of the search's window, m and rad.
BEYOND = np.array([0.05, 0.05, 0.1])


@dataclass(frozen=True, slots=True)
class Closure:
    """A place found for a keyframe, with what it was judged by.

    Attributes:
        i, j: ids of the anchor (in the target) and of the new keyframe.
        Z: pose of j in i: x, y (m), heading (rad), shape (3,).
        covariance: of it, as a twist in j's frame, shape (3, 3).
        dz: height of j over i, m.
        match: the refined match.
        uniqueness: cost of the next best place over that of this one.
        moved: Mahalanobis distance of Z from the prediction.
        good: whether it passed every check.
    """

    i: int
    j: int
    Z: FloatArray
    covariance: FloatArray
    dz: float
    match: SurfaceMatch
    uniqueness: float
    moved: float
    good: bool


class ClosureSearch:
    """Finds closures; holds no map of its own.

    Args:
        parameters: with units and reasons there.
        model: how touches make a surface.
    """

    def __init__(self, parameters: ClosureSection, model: SurfaceModel) -> None:
        self._parameters = parameters
        self._model = model

    def passes(
        self, new: int, patches: Mapping[int, Patch], poses: Mapping[int, FloatArray], reach: float
    ) -> list[list[int]]:
        """Earlier keyframes near the predicted place, by drives over it, nearest first; each in the order of ids.

        Args:
            new: id of the keyframe to be placed.
            patches: touches by keyframe.
            poses: x, y, heading by keyframe, in map.
            reach: how far the prediction may be off, m.
        """
        parameters = self._parameters
        ids = np.array(sorted(patches), dtype=np.int64)
        travelled = np.array([patches[k].travelled for k in ids])
        xy = np.array([poses[k][:2] for k in ids])
        distance = np.hypot(*(xy - poses[new][:2]).T)
        old = travelled <= patches[new].travelled - parameters.min_travel
        near = np.flatnonzero(old & (distance <= parameters.target_radius + reach))
        if not len(near):
            return []
        runs = np.split(near, np.flatnonzero(np.diff(travelled[near]) > 2.0 * parameters.target_radius) + 1)
        runs.sort(key=lambda run: float(distance[run].min()))
        return [[int(k) for k in ids[run]] for run in runs[: parameters.max_targets]]

    def find(
        self,
        source: Patch,
        new: int,
        targets: Sequence[int],
        patches: Mapping[int, Patch],
        poses: Mapping[int, FloatArray],
        dz: float,
        prediction: FloatArray,
        covariance: FloatArray,
        patch_covariance: FloatArray,
        anchor: int,
    ) -> Closure | None:
        """Search one pass; None if nothing overlaps enough.

        Args:
            source: touches in the new keyframe's level frame.
            new: its id.
            targets: ids of the pass.
            patches, poses: as of `passes`.
            dz: predicted height of the new keyframe over the anchor, m.
            prediction: pose of the new keyframe in the anchor, shape (3,).
            covariance: of it, as a twist in the new keyframe's frame, shape (3, 3).
            patch_covariance: of the source's touches as a whole against its newest, likewise.
            anchor: the target's frame: one of `targets`.
        """
        parameters = self._parameters
        places = np.zeros((len(targets), 4))
        places[:, :3] = geometry.se2_compose(geometry.se2_inverse(poses[anchor]), np.stack([poses[k] for k in targets]))
        target = np.concatenate([placed(patches[k].points, place) for k, place in zip(targets, places, strict=True)])
        points = _thinned(source.points, parameters.points)
        up = np.array([0.0, 0.0, dz])
        points = points + up
        c, s = np.cos(prediction[YAW]), np.sin(prediction[YAW])
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        prior = R @ covariance @ R.T
        half = self._window(prior, len(source.walls) > 0)
        rim = float(np.hypot(points[:, 0], points[:, 1]).max())
        reach = rim + half[:2] + 3.0 * parameters.cell
        low, high = prediction[:2] - reach, prediction[:2] + reach
        target = target[_within(target, low, high)]
        if len(target) < len(points) * parameters.min_overlap:
            return None
        yaw_step = np.deg2rad(parameters.yaw_step_deg)
        # The touches lie behind the robot: grid and surface need only reach where they come to.
        xy = turned(points, headings(prediction[YAW], half[YAW], yaw_step)) + prediction[:2]
        first, last = xy.min(axis=(0, 1)) - half[:2], xy.max(axis=(0, 1)) + half[:2]
        margin = 4.0 * parameters.cell
        found = search(
            SearchGrid(target, *grid_within(low, (first - margin, last + margin), parameters.cell), parameters.cell),
            points,
            prediction,
            half,
            yaw_step,
            parameters.min_overlap,
            (self._model.touch_sigma / HEIGHT_SIGMA) ** 2 * 10.0,
            ALTERNATIVES,
        )
        if not len(found.poses):
            return None
        margin = BEYOND[X] + BEYOND[YAW] * rim + self._model.reach
        ground = target[_within(target, first - margin, last + margin)]
        walls = self._walls(source.walls + up, targets, places, patches, prediction[:2], half)
        match, unique = self._refined(Surface(ground, self._model), points, found.poses, walls)
        patch = R @ patch_covariance @ R.T
        return self._judged(match, unique, walls is not None, prediction, prior, patch, half, new, anchor, dz)

    def _walls(
        self,
        touches: FloatArray,
        targets: Sequence[int],
        places: FloatArray,
        patches: Mapping[int, Patch],
        middle: FloatArray,
        half: FloatArray,
    ) -> WallTouches | None:
        """Touches of walls (m, 3) and the pass's walls about where they may come to; None if there are none."""
        if not len(touches):
            return None
        points = _thinned(touches, self._parameters.points)
        parts = [placed(patches[k].walls, place) for k, place in zip(targets, places, strict=True)]
        walls = voxel_filter(np.concatenate(parts), WALL_VOXEL)
        reach = float(np.hypot(points[:, 0], points[:, 1]).max()) + half[:2] + BEYOND[X] + self._model.reach
        walls = walls[_within(walls, middle - reach, middle + reach)]
        return WallTouches(WallSurface(walls, self._model), points) if len(walls) else None

    def _refined(
        self, surface: Surface, points: FloatArray, places: FloatArray, walls: WallTouches | None
    ) -> tuple[SurfaceMatch, float]:
        """The best of the places after refinement, and by how much the next best that is another costs more."""
        height_prior = np.zeros((4, 4))
        height_prior[Z, Z] = 1.0 / HEIGHT_SIGMA**2
        guesses = np.column_stack([places, np.zeros(len(places))])
        matches = fit_each(surface, points, guesses, height_prior, ASSOCIATIONS, APART, walls)
        enough = [m for m in matches if m.overlap >= self._parameters.min_overlap] or matches
        best = min(enough, key=lambda m: m.cost)
        others = [m.cost for m in enough if not _same(m.pose, best.pose)]
        return best, min(others, default=np.inf) / max(best.cost, 1e-12)

    def _window(self, prior: FloatArray, walled: bool) -> FloatArray:
        """Half size of the search in x, y and heading; wider with touches of walls."""
        p = self._parameters
        sigma = p.sigmas * np.sqrt(np.diag(prior))
        low = np.array([p.min_window, p.min_window, np.deg2rad(p.min_yaw_window_deg)])
        widest = p.max_window_walls if walled else p.max_window
        high = np.array([widest, widest, np.deg2rad(p.max_yaw_window_deg)])
        return np.clip(sigma, low, high)

    def _judged(
        self,
        match: SurfaceMatch,
        unique: float,
        walled: bool,
        prediction: FloatArray,
        prior: FloatArray,
        patch: FloatArray,
        half: FloatArray,
        new: int,
        anchor: int,
        dz: float,
    ) -> Closure:
        p = self._parameters
        planar = height_left_free(match.information)
        floor = np.square([p.floor, p.floor, np.deg2rad(p.floor_yaw_deg)])
        quality = (match.rms / self._model.touch_sigma) ** 2
        covariance = p.inflation * quality * np.linalg.inv(planar + np.eye(3)) + np.diag(floor) + patch
        least = np.linalg.eigvalsh(planar)[0]
        off = match.pose[:3] - prediction
        off[YAW] = geometry.wrap_angle(off[YAW])
        moved = float(np.sqrt(off @ np.linalg.solve(prior + covariance, off)))
        across, along = np.linalg.eigvalsh(covariance[:2, :2]).tolist()
        good = (
            match.overlap >= p.min_overlap
            and match.inliers >= p.min_inliers
            and match.relief >= p.min_contrast * match.rms
            and unique >= p.uniqueness
            and moved <= p.max_moved
            and least > 0.0
            and across <= p.max_sigma**2
            and along <= max(p.max_sigma, p.max_sigma_along if walled else p.max_sigma) ** 2
            and covariance[YAW, YAW] <= np.deg2rad(p.max_sigma_yaw_deg) ** 2
            and bool((np.abs(off) <= half + BEYOND).all())
        )
        c, s = np.cos(match.pose[YAW]), np.sin(match.pose[YAW])
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return Closure(
            anchor,
            new,
            np.array([match.pose[X], match.pose[Y], match.pose[YAW]]),
            R @ covariance @ R.T,
            dz + float(match.pose[Z]),
            match,
            unique,
            moved,
            good,
        )


def _within(points: FloatArray, low: FloatArray, high: FloatArray) -> NDArray[np.bool_]:
    """Which points (n, 2 or more) lie in a box, shape (n,)."""
    x, y = points[:, 0], points[:, 1]
    return np.asarray((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))


def _same(a: FloatArray, b: FloatArray) -> bool:
    """Whether two poses are the same place."""
    near = np.hypot(a[X] - b[X], a[Y] - b[Y]) <= SAME_DISTANCE
    return bool(near and abs(geometry.wrap_angle(a[YAW] - b[YAW])) <= SAME_ANGLE)


def _thinned(points: FloatArray, count: int) -> FloatArray:
    """About `count` of the points, evenly along their order."""
    if len(points) <= count:
        return points
    return points[np.linspace(0, len(points) - 1, count).astype(np.int64)]
