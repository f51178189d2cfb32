"""The method `robust` in a map that was there before: found first, then gone on with, or followed frozen.

Until the place is known, the session has a graph of its own and the map stays as it was (`relocalisation`). Then
both are joined by the matches that told the place, and all that the session has touched enters the map at once;
in a frozen map, only the pose follows (`frozen_tracking`).

A robot that was carried away is noticed by two signs together: the ground under the whiskers ceased to be that of a
moment ago (`Keyframe.breaks`), and the map contradicts several keyframes in a row. Keyframes under suspicion are
held back, so that the map never gets them if the suspicion holds. Flooded or changed ground has only the second
sign, and is no reason to give the place up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.slam.closure_search import Closure
from robominer_slam.slam.composite_scan import voxel_filter
from robominer_slam.slam.frozen_tracking import FrozenTracker
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe
from robominer_slam.slam.level_map import LevelMap, from_saved
from robominer_slam.slam.map_ground import MapGround
from robominer_slam.slam.place_prior import PlacePrior
from robominer_slam.slam.relocalisation import Place, Relocaliser, SessionKeyframe
from robominer_slam.slam.robust import levelled
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.slam.session_backend import SessionBackend
from robominer_slam.slam.surface import SurfaceModel
from robominer_slam.slam.surface_registration import YAW, SurfaceMatch

FloatArray = NDArray[np.float64]

#: While the place is not known: 10 m, and any heading.
UNKNOWN = np.diag([100.0, 100.0, 10.0])


class LocalisedBackend:
    """Takes keyframes one after the other; deterministic."""

    def __init__(self, parameters: RobustSlamSection, known: SavedMap | None = None, frozen: bool = False) -> None:
        """Start with an empty map, or with a known one in which the place is to be found.

        Args:
            parameters: with units and reasons there.
            known: the map; None to begin a new one.
            frozen: whether it must stay as it is.
        """
        self._parameters = parameters
        s = parameters.surface
        self._model = SurfaceModel(s.touch_sigma, s.curvature, s.slope_sigma, s.reach)
        self._frozen = frozen
        self._session = SessionBackend(parameters)
        self._held: list[Keyframe] = []
        self._T_map_odom = np.eye(4)
        self._version = 0
        self._doubts = _Doubts(parameters)
        self._base = LevelMap()
        self._ground: MapGround | None = None
        self._relocaliser: Relocaliser | None = None
        self._tracker: FrozenTracker | None = None
        self._poses, self._ids = np.zeros((0, 4, 4)), tuple[int, ...]()
        self._edges: tuple[GraphEdge, ...] = ()
        if known is not None:
            self._poses, self._ids, self._edges = known.poses, known.ids, tuple(known.edges)
            self._search_in(from_saved(known, parameters.point_voxel), None)

    @property
    def localised(self) -> bool:
        """Whether the place in the map is known."""
        return self._relocaliser is None

    def process(self, keyframe: Keyframe) -> BackendResult:
        """Add a keyframe: to the map, to the session whose place is looked for, or to nothing but the pose."""
        self._version += 1
        if keyframe.prior is not None:
            self._replaced(keyframe.prior)
        if self._frozen:
            return self._followed(keyframe)
        result = self._session.process(keyframe)
        return self._mapped(keyframe, result) if self.localised else self._searched(keyframe)

    # -------------------------------------------------------------------------------------------- looking for it

    def _search_in(self, base: LevelMap, prior: PlacePrior | None) -> None:
        """Begin a session whose place in `base` is not known."""
        p = self._parameters.relocalisation
        if base is not self._base or self._ground is None:
            self._ground = MapGround(base.touches(), self._model, self._parameters.point_voxel, p.cell, p.reach)
        self._base = base
        self._relocaliser = Relocaliser(p, self._ground, self._parameters.closure.inflation)
        self._tracker = None
        self._session = SessionBackend(self._parameters)
        self._held = []
        self._doubts = _Doubts(self._parameters)
        if prior is not None:
            self._relocaliser.expect(prior)

    def _replaced(self, prior: PlacePrior) -> None:
        """The operator says where the robot is now; how it came there is not known."""
        base = self._base
        if self.localised and not self._frozen:
            base = self._session.level_map().without({k.id for k in self._held})
        if base.poses:
            self._search_in(base, prior)

    def _searched(self, keyframe: Keyframe) -> BackendResult:
        self._held.append(keyframe)
        assert self._relocaliser is not None
        place = self._relocaliser.add(self._session_keyframe(keyframe))
        if place is None:
            return self._unknown(keyframe)
        ties = [self._tie(vote) for vote in self._relocaliser.agreeing]
        own = self._session.pose(keyframe.id)
        origin = np.append(geometry.se2_compose(place.pose[:3], geometry.se2_inverse(own[:3])), place.pose[3] - own[3])
        self._session.adopt(self._base, origin, ties)
        self._relocaliser, self._ground, self._base = None, None, LevelMap()
        entered, self._held = tuple(self._held), []
        return self._known(self._session.present(keyframe, len(ties)), entered)

    def _unknown(self, keyframe: Keyframe) -> BackendResult:
        return BackendResult(
            keyframe, self._T_map_odom, self._poses, UNKNOWN, self._edges, 0, self._version, (), self._ids, False
        )

    def _tie(self, place: Place) -> Closure:
        """A place that was found, as a closure with the nearest keyframe of the map."""
        assert self._relocaliser is not None
        anchor = self._base.nearest(place.pose[:2])
        p = self._parameters.closure
        covariance = self._relocaliser.covariance(place.match)
        assert covariance is not None
        covariance = covariance + np.diag(np.square([p.floor, p.floor, np.deg2rad(p.floor_yaw_deg)]))
        c, s = np.cos(place.pose[YAW]), np.sin(place.pose[YAW])
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        Z = geometry.se2_compose(geometry.se2_inverse(self._base.poses[anchor]), place.pose[:3])
        dz = float(place.pose[3]) - self._base.heights[anchor]
        return Closure(anchor, place.id, Z, R @ covariance @ R.T, dz, place.match, place.lead, 0.0, True)

    def _session_keyframe(self, keyframe: Keyframe) -> SessionKeyframe:
        level, tilt = levelled(keyframe.T_odom_base)
        points = voxel_filter(keyframe.points @ tilt.T, self._parameters.point_voxel)
        return SessionKeyframe(keyframe.id, level, points, keyframe.travelled)

    # -------------------------------------------------------------------------------------------------- mapping

    def _mapped(self, keyframe: Keyframe, result: BackendResult) -> BackendResult:
        match = None if result.closures else self._session.look(keyframe, self._model)
        self._doubts.judge(keyframe, match)
        self._held.append(keyframe)
        if self._doubts.carried_away:
            held = self._held
            self._search_in(self._session.level_map().without({k.id for k in held}), None)
            for one in held:
                self._session.process(one)
                last = self._searched(one)
            return last
        if self._doubts.count:
            return self._known(result, ())
        entered, self._held = tuple(self._held), []
        return self._known(result, entered)

    def _known(self, result: BackendResult, entered: tuple[Keyframe, ...]) -> BackendResult:
        """A result of the session's graph, without the keyframes that are held back."""
        ids = self._session.ids
        poses, edges = result.poses, result.edges
        if self._held:
            held = {k.id for k in self._held}
            kept = [n for n, k in enumerate(ids) if k not in held]
            ids, poses = tuple(ids[n] for n in kept), poses[kept]
            edges = tuple(e for e in edges if e.i not in held and e.j not in held)
        self._poses, self._ids, self._edges = poses, ids, tuple(edges)
        self._T_map_odom = result.T_map_odom
        return replace(result, poses=poses, ids=ids, edges=edges, entered=entered, version=self._version)

    # ------------------------------------------------------------------------------------------------ frozen map

    def _followed(self, keyframe: Keyframe) -> BackendResult:
        taken = self._session_keyframe(keyframe)
        if self._tracker is None:
            assert self._relocaliser is not None
            assert self._ground is not None
            place = self._relocaliser.add(taken)
            if place is None:
                return self._unknown(keyframe)
            covariance = self._relocaliser.covariance(place.match)
            assert covariance is not None
            self._tracker = FrozenTracker(self._parameters, self._ground, taken, place.pose, covariance)
            self._relocaliser = None
        else:
            self._doubts.judge(keyframe, self._tracker.follow(keyframe, taken))
            if self._doubts.carried_away:
                self._search_in(self._base, None)
                return self._followed(keyframe)
        level, tilt = self._tracker.pose, levelled(keyframe.T_odom_base)[1]
        T = geometry.T_from_xyyaw(level[:3])
        T[2, 3] = level[3]
        T[:3, :3] = T[:3, :3] @ tilt
        self._T_map_odom = geometry.normalise_pose(T @ geometry.inverse(keyframe.T_odom_base))
        return BackendResult(
            keyframe, self._T_map_odom, self._poses, self._tracker.covariance.copy(), self._edges, 0, self._version,
            (), self._ids,
        )  # fmt: skip


class _Doubts:
    """Counts keyframes in a row that the map contradicts.

    Attributes:
        count: of them.
    """

    def __init__(self, parameters: RobustSlamSection) -> None:
        self._parameters = parameters.relocalisation
        self._breaks: list[int] = []
        self._broken = False
        self.count = 0

    def judge(self, keyframe: Keyframe, match: SurfaceMatch | None) -> None:
        """Take a keyframe and how it fits where it is thought to be; None where nothing is known there."""
        p = self._parameters
        # The break is noticed up to two keyframes after the first that was touched elsewhere, or before it.
        self._breaks = [*self._breaks, keyframe.breaks][-(p.contradictions + 3) :]
        if match is None or match.overlap < p.min_overlap_tracking:
            return
        self.count = self.count + 1 if match.inliers < p.max_inliers_contradiction else 0

    @property
    def carried_away(self) -> bool:
        """Whether the robot cannot be where it is thought to be."""
        return self.count >= self._parameters.contradictions and self._breaks[-1] > self._breaks[0]
