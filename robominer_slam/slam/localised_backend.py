"""The method `robust` in a map that was there before: found first, then gone on with, or followed frozen.

Until the place is known, the session has a graph of its own and the map stays as it was (`relocalisation`). Then
both are joined by the matches that told the place, and all that the session has touched enters the map at once;
in a frozen map, only the pose follows (`frozen_tracking`).

While there is doubt whether the robot was carried away (`doubts`), keyframes are held back, and the whole map is
searched for what they touched: a second opinion. The map never gets them if the robot turns out to be elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.slam.closure_search import Closure
from robominer_slam.slam.composite_scan import voxel_filter
from robominer_slam.slam.doubts import Doubts
from robominer_slam.slam.frozen_tracking import FrozenTracker
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe
from robominer_slam.slam.level_map import LevelMap, from_saved
from robominer_slam.slam.map_ground import MapGround
from robominer_slam.slam.patch_memory import PatchPages
from robominer_slam.slam.place_prior import PlacePrior
from robominer_slam.slam.relocalisation import Place, Relocaliser, SessionKeyframe
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.slam.session_backend import SessionBackend
from robominer_slam.slam.surface import SurfaceModel
from robominer_slam.slam.surface_registration import YAW
from robominer_slam.slam.untold_changes import UntoldChanges

FloatArray = NDArray[np.float64]

#: While the place is not known: 10 m, and any heading.
UNKNOWN = np.diag([100.0, 100.0, 10.0])


class LocalisedBackend:
    """Takes keyframes one after the other; deterministic."""

    def __init__(
        self,
        parameters: RobustSlamSection,
        known: SavedMap | None = None,
        frozen: bool = False,
        pages: Callable[[], PatchPages] | None = None,
    ) -> None:
        """Start with an empty map, or with a known one in which the place is to be found.

        Args:
            parameters: with units and reasons there.
            known: the map; None to begin a new one.
            frozen: whether it must stay as it is.
            pages: makes a place for touches that do not fit into memory; None keeps all there.
        """
        self._parameters = parameters
        self._model = SurfaceModel.of(parameters.surface)
        self._frozen = frozen
        self._pages = pages
        self._session = self._new_session()
        self._untold = UntoldChanges()
        self._counts: Mapping[str, int] = {}
        self._held: list[Keyframe] = []
        self._T_map_odom = np.eye(4)
        self._version = 0
        self._doubts = Doubts(parameters.relocalisation)
        self._base = LevelMap()
        self._ground: MapGround | None = None
        self._relocaliser: Relocaliser | None = None
        self._second_opinion: Relocaliser | None = None
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
        # What is held back may turn out to be elsewhere: until then nothing goes because of it.
        self._session.bounded = self.localised and not self._held
        result = self._session.process(keyframe)
        self._untold.note(result)
        self._counts = result.counts
        return self._mapped(keyframe, result) if self.localised else self._searched(keyframe)

    def release(self) -> None:
        """Let go of what must be freed in the thread that made it."""
        self._session.release()

    def _new_session(self) -> SessionBackend:
        return SessionBackend(self._parameters, None if self._pages is None else self._pages())

    # -------------------------------------------------------------------------------------------- looking for it

    def _search_in(self, base: LevelMap, prior: PlacePrior | None) -> None:
        """Begin a session whose place in `base` is not known."""
        p = self._parameters.relocalisation
        if base is not self._base or self._ground is None:
            self._ground = MapGround(base.touches(), self._model, self._parameters.point_voxel, p.cell, p.reach)
        self._base = base
        self._relocaliser = Relocaliser(p, self._ground, self._parameters.closure.inflation)
        self._tracker = self._second_opinion = None
        self._session = self._new_session()
        self._held, self._untold.edges = [], []
        self._doubts = Doubts(self._parameters.relocalisation)
        if prior is not None:
            self._relocaliser.expect(prior)

    def _replaced(self, prior: PlacePrior) -> None:
        """The operator says where the robot is now; how it came there is not known."""
        base = self._base
        if self.localised and not self._frozen:
            base = self._settled()
        if base.poses:
            self._search_in(base, prior)

    def _searched(self, keyframe: Keyframe) -> BackendResult:
        self._held.append(keyframe)
        assert self._relocaliser is not None
        place = self._relocaliser.add(self._session_keyframe(keyframe))
        return self._unknown(keyframe) if place is None else self._joined(keyframe, place, self._relocaliser)

    def _joined(self, keyframe: Keyframe, place: Place, found_by: Relocaliser) -> BackendResult:
        """The session, all of it held back so far, becomes part of the map."""
        ties = [self._tie(vote, found_by) for vote in found_by.agreeing]
        own = self._session.pose(keyframe.id)
        origin = np.append(geometry.se2_compose(place.pose[:3], geometry.se2_inverse(own[:3])), place.pose[3] - own[3])
        self._session.adopt(self._base, origin, ties)
        self._relocaliser, self._ground, self._base = None, None, LevelMap()
        entered, self._held = tuple(self._held), []
        result = self._session.present(keyframe, len(ties))
        had = {(e.kind, e.i, e.j) for e in self._edges}
        self._untold.edges += [e for e in result.added or () if (e.kind, e.i, e.j) not in had]
        return self._known(result, entered)

    def _unknown(self, keyframe: Keyframe) -> BackendResult:
        return BackendResult(
            keyframe, self._T_map_odom, self._poses, UNKNOWN, self._edges, 0, self._version, (), self._ids, False,
            added=(), counts=self._counts,
        )  # fmt: skip

    def _tie(self, place: Place, found_by: Relocaliser) -> Closure:
        """A place that was found, as a closure with the nearest keyframe of the map."""
        anchor = self._base.nearest(place.pose[:2])
        p = self._parameters.closure
        covariance = found_by.covariance(place.match)
        assert covariance is not None
        covariance = covariance + np.diag(np.square([p.floor, p.floor, np.deg2rad(p.floor_yaw_deg)]))
        c, s = np.cos(place.pose[YAW]), np.sin(place.pose[YAW])
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        Z = geometry.se2_compose(geometry.se2_inverse(self._base.poses[anchor]), place.pose[:3])
        dz = float(place.pose[3]) - self._base.heights[anchor]
        return Closure(anchor, place.id, Z, R @ covariance @ R.T, dz, place.match, place.lead, 0.0, True)

    def _session_keyframe(self, keyframe: Keyframe) -> SessionKeyframe:
        level, tilt = geometry.levelled(keyframe.T_odom_base)
        points = voxel_filter(keyframe.floor_points @ tilt.T, self._parameters.point_voxel)
        return SessionKeyframe(keyframe.id, level, points, keyframe.travelled)

    # -------------------------------------------------------------------------------------------------- mapping

    def _mapped(self, keyframe: Keyframe, result: BackendResult) -> BackendResult:
        self._doubts.notice(keyframe)
        self._held.append(keyframe)
        closed = result.closures > 0
        # After a break, what was touched before it is what the robot may have left.
        recent = {k.id for k in self._held} if self._doubts.broken else None
        asked = not closed and self._doubts.are_sensible(result.covariance)
        self._doubts.judge(self._session.look(keyframe, self._model, recent) if asked else None, closed)
        if self._doubts.any:
            return self._doubted(keyframe, result)
        self._second_opinion, self._ground = None, None
        entered, self._held = tuple(self._held), []
        return self._known(result, entered)

    def _doubted(self, keyframe: Keyframe, result: BackendResult) -> BackendResult:
        if len(self._session.ids) == len(self._held):
            self._doubts.clear()
            entered, self._held = tuple(self._held), []
            return self._known(result, entered)
        if self._ground is None:
            p = self._parameters
            touches = self._settled().touches()
            self._ground = MapGround(touches, self._model, p.point_voxel, p.relocalisation.cell, p.relocalisation.reach)
        place = self._asked(self._held if self._second_opinion is None else [keyframe])
        if place is not None and self._near(place.pose, self._session.pose(keyframe.id)):
            self._doubts.clear()
        elif place is not None or self._doubts.carried_away:
            return self._carried_away(self._settled(), keyframe, place)
        return replace(self._known(result, ()), localised=not self._doubts.broken)

    def _settled(self) -> LevelMap:
        """The map without the keyframes that are held back."""
        return self._session.level_map().without({k.id for k in self._held})

    def _asked(self, keyframes: Sequence[Keyframe]) -> Place | None:
        """Where the whole map says that the newest keyframe is, if it is sure."""
        if self._second_opinion is None:
            assert self._ground is not None
            p = self._parameters
            self._second_opinion = Relocaliser(p.relocalisation, self._ground, p.closure.inflation)
        place = None
        for one in keyframes:
            place = self._second_opinion.add(self._session_keyframe(one))
        return place

    def _carried_away(self, base: LevelMap, keyframe: Keyframe, place: Place | None) -> BackendResult:
        """What is held back becomes a session of its own; the map ends before it."""
        held, found_by = self._held, self._second_opinion
        assert found_by is not None
        self._base, self._relocaliser = base, found_by
        self._second_opinion = None
        self._session = self._new_session()
        self._session.bounded = False
        self._doubts = Doubts(self._parameters.relocalisation)
        self._untold.edges = []
        for one in held:
            self._untold.note(self._session.process(one))
        return self._unknown(keyframe) if place is None else self._joined(keyframe, place, found_by)

    def _near(self, a: FloatArray, b: FloatArray) -> bool:
        far = self._parameters.relocalisation.elsewhere
        return bool(np.hypot(*(a[:2] - b[:2])) <= far) and abs(float(geometry.wrap_angle(a[YAW] - b[YAW]))) <= far

    def _known(self, result: BackendResult, entered: tuple[Keyframe, ...]) -> BackendResult:
        """A result of the session's graph, without the keyframes that are held back."""
        ids = self._session.ids
        poses, edges = result.poses, result.edges
        held = {k.id for k in self._held}
        result = self._untold.told(result, held)
        if held:
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
            place = self._relocaliser.add(taken)
            if place is None:
                return self._unknown(keyframe)
            self._track(taken, place, self._relocaliser)
        else:
            self._doubts.notice(keyframe)
            self._doubts.judge(self._tracker.follow(keyframe, taken))
            if not self._doubts.any and not self._tracker.uncertain:
                self._second_opinion = None
            else:
                place = self._asked([keyframe])
                assert self._second_opinion is not None
                here = place is not None and self._near(place.pose, self._tracker.pose)
                if place is not None and (self._tracker.uncertain or not here):
                    self._track(taken, place, self._second_opinion)
                elif place is not None:
                    self._doubts.clear()
                elif self._doubts.carried_away:
                    self._relocaliser, self._second_opinion, self._tracker = self._second_opinion, None, None
                    return self._unknown(keyframe)
        assert self._tracker is not None
        level, tilt = self._tracker.pose, geometry.levelled(keyframe.T_odom_base)[1]
        T = geometry.T_from_xyyaw(level[:3])
        T[2, 3] = level[3]
        T[:3, :3] = T[:3, :3] @ tilt
        self._T_map_odom = geometry.normalise_pose(T @ geometry.inverse(keyframe.T_odom_base))
        return BackendResult(
            keyframe, self._T_map_odom, self._poses, self._tracker.covariance.copy(), self._edges, 0, self._version,
            (), self._ids, not self._doubts.broken, added=(),
        )  # fmt: skip

    def _track(self, keyframe: SessionKeyframe, place: Place, found_by: Relocaliser) -> None:
        covariance = found_by.covariance(place.match)
        assert covariance is not None
        assert self._ground is not None
        self._tracker = FrozenTracker(self._parameters, self._ground, keyframe, place.pose, covariance)
        self._relocaliser, self._second_opinion = None, None
        self._doubts = Doubts(self._parameters.relocalisation)
