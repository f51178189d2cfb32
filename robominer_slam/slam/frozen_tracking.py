"""Follows the robot in a map that never changes: prediction by odometry, correction by fitting touches onto the map.

Source: the Kalman filter over x, y and heading as in Thrun et al., "Probabilistic robotics" (2005), chapter 7; the
correction's covariance is that of a closure, so that it never claims more than a match can know.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.slam.keyframe import Keyframe
from robominer_slam.slam.map_ground import MapGround
from robominer_slam.slam.relocalisation import SessionKeyframe, carried, relative, thinned
from robominer_slam.slam.robust import PLANAR
from robominer_slam.slam.surface_registration import YAW, SurfaceMatch, fit, height_left_free, placed

FloatArray = NDArray[np.float64]

#: Of odometry's step where it does not tell its noise: m, m, rad per keyframe.
STEP_SIGMAS = (0.01, 0.01, 0.01)
#: Beyond these a match from the prediction may be a neighbour of the right one: only a search tells, m and rad.
UNCERTAIN_M, UNCERTAIN_YAW = 0.05, 0.06
#: Chi-square of a correction, three axes: 0.1 % by chance.
GATE = 16.3


class FrozenTracker:
    """Takes keyframes one after the other.

    Attributes:
        pose: x, y, heading, z of the newest keyframe in map, shape (4,).
        covariance: of x, y, heading in map, shape (3, 3).
    """

    def __init__(
        self,
        parameters: RobustSlamSection,
        ground: MapGround,
        keyframe: SessionKeyframe,
        pose: FloatArray,
        covariance: FloatArray,
    ) -> None:
        """Start where the keyframe was found to be, in map."""
        self._parameters = parameters
        self._ground = ground
        self._session = [keyframe]
        self.pose = pose
        self.covariance = covariance

    def follow(self, raw: Keyframe, keyframe: SessionKeyframe) -> SurfaceMatch | None:
        """Take the next keyframe; how its touches fit the map, None where they are too few."""
        before = self._session[-1]
        self.pose = carried(self.pose, before.pose, keyframe.pose)
        self.covariance = self._grown(raw, relative(before.pose, keyframe.pose))
        way = self._parameters.closure.patch
        self._session = [
            k for k in (*self._session, keyframe) if keyframe.travelled - k.travelled < way or k is keyframe
        ]
        points = np.concatenate([placed(k.points, relative(keyframe.pose, k.pose)) for k in self._session])
        if len(points) < 60:
            return None
        points = thinned(points, self._parameters.closure.points)
        # The touches' own minimum, found from the prediction; what they leave free stays there.
        prior = np.diag([1.0 / 0.1**2, 1.0 / 0.1**2, 1.0 / 0.1**2, 1.0 / 0.02**2])
        match = fit(self._ground.surface, points, self.pose, prior, 3)
        section = self._parameters.relocalisation
        enough = match.overlap >= self._parameters.closure.min_overlap and match.inliers >= section.min_inliers_window
        if enough and not self.uncertain:
            self._correct(match)
        return match

    @property
    def uncertain(self) -> bool:
        """Whether the prediction is too vague for a match to correct it: after a way over unmapped ground."""
        sigma = float(np.sqrt(np.linalg.eigvalsh(self.covariance[:2, :2])[-1]))
        return sigma > UNCERTAIN_M or bool(np.sqrt(self.covariance[YAW, YAW]) > UNCERTAIN_YAW)

    def _grown(self, raw: Keyframe, step: FloatArray) -> FloatArray:
        """Covariance of x, y, heading in map after a step."""
        if raw.motion is None:
            Q = np.diag(np.square(STEP_SIGMAS))
        else:
            J = raw.motion.bias_jacobian[PLANAR]
            Q = raw.motion.covariance[np.ix_(PLANAR, PLANAR)] + J @ raw.motion.bias_covariance @ J.T
        yaw = float(self.pose[YAW])
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        # A wrong heading before the step moves its end sideways.
        before = yaw - step[YAW]
        dx = np.cos(before) * step[0] - np.sin(before) * step[1]
        dy = np.sin(before) * step[0] + np.cos(before) * step[1]
        F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        grown: FloatArray = F @ self.covariance @ F.T + R @ Q @ R.T
        return grown

    def _correct(self, match: SurfaceMatch) -> None:
        p = self._parameters.closure
        planar = height_left_free(match.information)
        floor = np.diag(np.square([p.floor, p.floor, np.deg2rad(p.floor_yaw_deg)]))
        noise = p.inflation * np.linalg.inv(planar + np.eye(3) * 1e-3) + floor
        innovation = match.pose[:3] - self.pose[:3]
        innovation[YAW] = geometry.wrap_angle(innovation[YAW])
        weight = np.linalg.inv(self.covariance + noise)
        if float(innovation @ weight @ innovation) > GATE:
            return
        K = self.covariance @ weight
        self.pose[:3] = self.pose[:3] + K @ innovation
        self.pose[3] = match.pose[3]
        # The map itself is no better than a match: matches on the same ground do not average that out.
        self.covariance = (np.eye(3) - K) @ self.covariance + floor * 0.5
