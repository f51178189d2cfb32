"""Scan matching as odometry: each few centimetres the whiskers' contacts are fitted onto the ground touched lately.

A row of whiskers comes where the row before it was half a second ago: their heights tell how far the robot has moved
since. What the ground does not constrain (a flat floor: x, y and heading) the information matrix says, and there
the dead reckoning rules. Contacts share the errors of their whiskers, so their information counts for a share only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.robust_slam_section import ScanMatchingSection
from robominer_slam.slam.local_map import LocalMap
from robominer_slam.slam.surface import Surface, SurfaceModel
from robominer_slam.slam.surface_registration import LEAST_KNOWN, YAW, SurfaceMatch, Z, fit, height_left_free, placed
from robominer_slam.slam.wall_odometry import way_along
from robominer_slam.slam.wall_surface import WallSurface

FloatArray = NDArray[np.float64]
#: x, y (m), yaw (rad) in odom.
Pose: TypeAlias = tuple[float, float, float]

#: Fewer contacts are not worth a match.
LEAST_CONTACTS = 8
#: How well the height is known from one match to the next, m.
HEIGHT_SIGMA = 0.002
#: Turning by 1 rad moves the whiskers by about this, m: travel counts both.
TURN_ARM = 0.15
#: Of the best known direction's information: a direction with less has none.
LEAST_SHARE = 1e-9
#: Of the apparent information along a direction, less than this is no more than errors of the slopes.
LEAST_VARIATION = 0.25
EYE = np.eye(3)
NOTHING = np.zeros((0, 3))
#: So many matches in a row in which less than this share fits, each over ground known to the other share, are a
#: break: on the thesis's ground the best of five never had less than 0.74, after being carried 0.3 to 0.66.
BREAK_MISFITS = 5
BREAK_INLIERS = 0.68
BREAK_OVERLAP = 0.5


@dataclass(frozen=True, slots=True)
class ScanCorrection:
    """What a match says about the predicted pose.

    Attributes:
        offset: of (x, y, yaw) in odom, measured less predicted, shape (3,).
        information: of it, already discounted, shape (3, 3); directions that nothing constrains have none.
    """

    offset: FloatArray
    information: FloatArray


class ScanOdometry:
    """Matches the frames of a drive with the local map.

    Attributes:
        matches, wall_matches: made so far, with floor and walls.
        travelled: way of the array, m.
        breaks: how often the ground ceased to be the one touched just before; the local map begins anew then.
    """

    def __init__(self, parameters: ScanMatchingSection, model: SurfaceModel, reach: float) -> None:
        """Start with an empty map.

        Args:
            parameters: with units and reasons there.
            model: how touches make a surface.
            reach: of the farthest contact from base_link, m.
        """
        self._parameters = parameters
        self._reach = reach
        kept = parameters.keep, parameters.age, parameters.cell, parameters.per_cell, parameters.rebuild
        self._map = LocalMap(partial(Surface, model=model), *kept)
        self._walls = LocalMap(partial(WallSurface, model=model), *kept)
        self._last: Pose | None = None
        self._before: Pose | None = None
        self.matches = self.wall_matches = 0
        self.travelled = 0.0
        self.breaks = 0
        self._misfits = 0

    def moved(self, x: float, y: float, yaw: float) -> bool:
        """Go on to a pose in odom, m and rad; whether it is far enough from the last match for another."""
        pose = x, y, yaw
        if self._before is not None:
            self.travelled += _way(self._before, pose)
        self._before = pose
        return self._due(pose)

    def match(self, pose: FloatArray, covariance: FloatArray, points: FloatArray) -> ScanCorrection | None:
        """Match a frame at a pose that the robot has `moved` to.

        Args:
            pose: predicted x, y, yaw, z in odom, shape (4,).
            covariance: of it since the reference that the map hangs on, shape (4, 4).
            points: contacts in base_link, levelled, shape (m, 3), m.
        """
        if len(points) < LEAST_CONTACTS:
            return None
        self._map.update(self.travelled, pose[:2], self._reach)
        if not len(self._map.surface):
            return None
        prior: FloatArray = np.asarray(np.linalg.inv(covariance + np.eye(4) * 1e-12), dtype=np.float64)
        found = fit(self._map.surface, points, pose, prior, associations=self._parameters.associations)
        if found.overlap * len(points) < LEAST_CONTACTS:
            return None
        if self._broken(found) or found.inliers < self._parameters.least_inliers:
            return None
        self.matches += 1
        offset = found.pose - pose
        offset[YAW] = math.remainder(offset[YAW], math.tau)
        # With the common height left free: what remains is about x, y and heading.
        # The touches' noise pulls at d as much as H says, whatever of H the slopes' errors have made up: with
        # H0 d = -g, the information of d is H0 H^-1 H0.
        known, apparent = height_left_free(found.information), height_left_free(found.curvature)
        varies = varying(known, apparent)
        known = varies.dot(known).dot(varies)
        information = known.dot(np.linalg.solve(apparent + 1e-9 * np.eye(3), known)) * self._parameters.share
        # The least-squares offset of the touches alone: H d = -g at the predicted pose.
        H = found.curvature
        gradient = found.gradient - H.dot(offset)
        reduced = gradient[:3] - H[:3, Z] * gradient[Z] / max(H[Z, Z], 1e-12)
        return ScanCorrection(_least(known, -varies.dot(reduced)), information)

    def match_walls(self, pose: FloatArray, walls: FloatArray) -> ScanCorrection | None:
        """Match a frame's contacts with walls, at a pose that the robot has `moved` to.

        Args:
            pose: as of `match`.
            walls: contacts of whiskers that do not point down in base_link, levelled, shape (m, 3), m.
        """
        if len(walls) <= LEAST_KNOWN:
            return None
        self._walls.update(self.travelled, pose[:2], self._reach)
        found = way_along(self._walls.surface, walls, pose) if len(self._walls.surface) else None
        if found is None or found.known < LEAST_VARIATION * found.apparent:
            return None
        self.wall_matches += 1
        information = np.zeros((3, 3))
        along = found.direction
        information[:2, :2] = along[:, None] * along * (found.known**2 / found.apparent * self._parameters.share)
        return ScanCorrection(np.append(along * found.offset, 0.0), information)

    def add(self, pose: FloatArray, points: FloatArray, walls: FloatArray = NOTHING) -> None:
        """Put a frame's contacts (in base_link, levelled) into the map at its corrected pose (x, y, yaw, z)."""
        x, y, yaw, _ = pose.tolist()
        if not self._due((x, y, yaw)):
            return
        self._last = x, y, yaw
        if len(points):
            self._map.add(self.travelled, placed(points, pose))
        if len(walls):
            self._walls.add(self.travelled, placed(walls, pose))

    def clear(self) -> None:
        """Forget the ground touched lately: the robot has been carried."""
        self._map.clear()
        self._walls.clear()
        self._last = self._before = None
        self._misfits = 0

    def _broken(self, found: SurfaceMatch) -> bool:
        """Whether this match completes a break; the local map begins anew then."""
        if found.inliers >= BREAK_INLIERS:
            self._misfits = 0
        elif found.overlap >= BREAK_OVERLAP:
            self._misfits += 1
        if self._misfits < BREAK_MISFITS:
            return False
        self.breaks += 1
        self.clear()
        return True

    def _due(self, pose: Pose) -> bool:
        return self._last is None or _way(self._last, pose) >= self._parameters.step


def with_height(covariance: FloatArray) -> FloatArray:
    """Covariance of (x, y, yaw), shape (3, 3), with that of the height beside it, shape (4, 4)."""
    whole = np.zeros((4, 4))
    whole[:3, :3] = covariance
    whole[3, 3] = HEIGHT_SIGMA**2
    return whole


def _way(a: Pose, b: Pose) -> float:
    """From one pose to the other as the whiskers go, m."""
    x_a, y_a, yaw_a = a
    x_b, y_b, yaw_b = b
    return math.hypot(x_b - x_a, y_b - y_a) + TURN_ARM * abs(math.remainder(yaw_b - yaw_a, math.tau))


def _least(information: FloatArray, right_side: FloatArray) -> FloatArray:
    """Shortest solution of H d = b: directions without information stay where they are."""
    values, vectors = np.linalg.eigh(information)
    known = values > LEAST_SHARE * values[-1]
    along = vectors.T.dot(right_side)
    solution: FloatArray = vectors.dot(np.divide(along, values, out=np.zeros(len(values)), where=known))
    return solution


def varying(known: FloatArray, apparent: FloatArray) -> FloatArray:
    """Projector, shape (3, 3), that takes out directions, and heading, in which the ground seems the same.

    Where slopes along a direction are mostly errors, so are their products with the others: the free direction of a
    corridor's H is turned a little out of the corridor's, has some heading in it, and would tell the place along the
    corridor by the heading.

    Args:
        known: information about (x, y, yaw), shape (3, 3).
        apparent: the same with what errors of the slopes add to it.
    """
    values, vectors = np.linalg.eigh(known[:2, :2])
    of_errors = ((vectors * apparent[:2, :2].dot(vectors)).sum(axis=0) * LEAST_VARIATION).tolist()
    projector = EYE.copy()
    for k, value in enumerate(values.tolist()):
        if value < of_errors[k]:
            along = vectors[:, k]
            projector[:2, :2] -= along[:, None] * along
    if known[YAW, YAW] < LEAST_VARIATION * apparent[YAW, YAW]:
        projector[YAW, YAW] = 0.0
    return projector
