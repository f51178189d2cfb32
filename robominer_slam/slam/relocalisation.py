"""Finds a session's place in a known map, from nothing but touches: search, judge, and wait for agreement.

With every keyframe, the touches of the last 0.7 m are searched for in the whole map (`global_search`); the best
places are refined (`surface_registration`) and weighed against each other and against ground that nobody has mapped
(`map_ground`). A search that is sure by itself casts a vote. The place is believed only when several votes, cast
over ground that does not overlap, agree with each other by the session's odometry, hardly any vote is for another
place, and all touches of the last 1.5 m fit there together. To be sure too early is the worst that can happen: the
robot would drive on a wrong map.

Sources: Fox et al., "Markov localization for mobile robots in dynamic environments" (JAIR 1999) for hypotheses and
their odds; Buchanan et al., "Haptic sequential Monte Carlo localization for quadrupedal locomotion" (2021) for
touches alone as evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.relocalisation_section import RelocalisationSection
from robominer_slam.slam.global_search import apart
from robominer_slam.slam.map_ground import MapGround
from robominer_slam.slam.place_prior import PlacePrior
from robominer_slam.slam.surface_registration import YAW, SurfaceMatch, fit, height_left_free, placed

FloatArray = NDArray[np.float64]

#: A patch of fewer touches is not searched for.
LEAST_POINTS = 100
#: Touches of the first, quick refinement; places that get the second one.
QUICK_POINTS = 120
REFINED = 4
#: Refined places nearer than this are one, m and rad.
SAME_DISTANCE = 0.10
SAME_ANGLE = 0.12
#: Size of a place in the count of places: as far as two touch patterns must be apart to differ.
PLACE_SIZE, PLACE_ANGLE = 0.05, 0.1


@dataclass(frozen=True, slots=True)
class SessionKeyframe:
    """A keyframe in the frame of its session.

    Attributes:
        id: of the keyframe.
        pose: x, y, yaw, z in the session's frame, level, shape (4,), m and rad.
        points: its touches in its own level frame, shape (m, 3), m.
        travelled: way driven up to it, m.
    """

    id: int
    pose: FloatArray
    points: FloatArray
    travelled: float


@dataclass(frozen=True, slots=True)
class Place:
    """A place in the map of one keyframe.

    Attributes:
        id: of the keyframe.
        pose: x, y, yaw, z in map, shape (4,).
        match: of its touches.
        log_odds: against unmapped ground, prior left out, touches discounted.
        lead: by which these exceed those of the next best place.
        travelled: way driven up to the keyframe, m.
    """

    id: int
    pose: FloatArray
    match: SurfaceMatch
    log_odds: float
    lead: float
    travelled: float


class Relocaliser:
    """Takes a session's keyframes one after the other until its place is known.

    Attributes:
        last: what the last search found, sure or not.
        agreeing: the votes that told the place, when it is known.
    """

    def __init__(self, parameters: RelocalisationSection, ground: MapGround, inflation: float) -> None:
        """Know nothing yet.

        Args:
            parameters: with units and reasons there.
            ground: of the known map.
            inflation: of a match's covariance: touches share errors.
        """
        self._parameters = parameters
        self._ground = ground
        self._inflation = inflation
        self._session: list[SessionKeyframe] = []
        self._votes: list[Place] = []
        self._prior: PlacePrior | None = None
        self.last: Place | None = None
        self.agreeing: list[Place] = []
        places = ground.search.area / PLACE_SIZE**2 * (2.0 * np.pi / PLACE_ANGLE)
        self._log_places = float(np.log(max(places, 1.0)))

    def expect(self, prior: PlacePrior) -> None:
        """Take the operator's word for the place of the next keyframe, within its sigma; touches must confirm it."""
        self._prior = prior

    def add(self, keyframe: SessionKeyframe) -> Place | None:
        """Take a keyframe; the place of it when it is known."""
        p = self._parameters
        self._session.append(keyframe)
        self._session = [k for k in self._session if keyframe.travelled - k.travelled < 2.0 * p.window]
        self._votes = [v for v in self._votes if v.id >= self._session[0].id]
        if self._prior is not None and self._prior.keyframe is None:
            self._prior = self._prior.at(keyframe.id, keyframe.pose)
        best = self._best(keyframe)
        self.last = best
        if best is None:
            return None
        if self._sure(best):
            self._votes.append(best)
        return self._elected(keyframe)

    # ------------------------------------------------------------------------------------------------ one search

    def _best(self, keyframe: SessionKeyframe) -> Place | None:
        p = self._parameters
        points = self._patch(keyframe, p.patch)
        if len(points) < LEAST_POINTS:
            return None
        points = thinned(points, p.points)
        found = self._ground.search.find(points, np.deg2rad(p.yaw_step_deg), p.min_overlap, p.candidates)
        guesses = [*found.poses, *(self._carried(v, keyframe) for v in self._votes[-1:])]
        if self._prior is not None:
            guesses += self._prior.guesses(keyframe.pose)
        if not guesses:
            return None
        quick = thinned(points, QUICK_POINTS)
        matches = [self._fit(quick, guess, 2) for guess in guesses]
        poses = np.array([m.pose for m in matches])
        odds = np.array([self._ground.log_odds(quick, pose) for pose in poses])
        chosen = apart(poses, odds, REFINED, SAME_DISTANCE, SAME_ANGLE)
        matches = [self._fit(points, poses[k], 2) for k in chosen]
        poses = np.array([m.pose for m in matches])
        odds = p.share * np.array([self._ground.log_odds(points, pose) for pose in poses])
        # The refinement may have led two to one place.
        order = apart(poses, odds, REFINED, SAME_DISTANCE, SAME_ANGLE)
        lead = float(odds[order[0]] - odds[order[1]]) if len(order) > 1 else float(odds[order[0]])
        k = int(order[0])
        return Place(keyframe.id, poses[k], matches[k], float(odds[k]), lead, keyframe.travelled)

    def _fit(self, points: FloatArray, guess: FloatArray, associations: int) -> SurfaceMatch:
        # As good as no prior: it keeps what the touches leave free where the search has put it.
        prior = np.diag([1.0 / 0.1**2, 1.0 / 0.1**2, 1.0 / 0.2**2, 1.0 / 0.05**2])
        return fit(self._ground.surface, points, guess, prior, associations)

    def _sure(self, place: Place) -> bool:
        p = self._parameters
        return (
            self._fits(place.match, p.min_inliers)
            and place.lead >= p.margin
            and place.log_odds - self._log_places >= p.margin
        )

    def _fits(self, match: SurfaceMatch, min_inliers: float) -> bool:
        p = self._parameters
        if match.overlap < p.min_overlap or match.inliers < min_inliers:
            return False
        if match.relief < p.min_contrast * match.rms:
            return False
        covariance = self.covariance(match)
        return bool(covariance is not None and np.linalg.eigvalsh(covariance[:2, :2])[-1] <= 0.03**2)

    def covariance(self, match: SurfaceMatch) -> FloatArray | None:
        """Of x, y, yaw in map, shape (3, 3); None where the touches leave a direction free."""
        planar = height_left_free(match.information)
        if np.linalg.eigvalsh(planar)[0] <= 1.0:
            return None
        covariance: FloatArray = np.asarray(self._inflation * np.linalg.inv(planar), dtype=np.float64)
        return covariance

    # ------------------------------------------------------------------------------------------------- agreement

    def _elected(self, keyframe: SessionKeyframe) -> Place | None:
        """The place of the keyframe by the votes, if they suffice and everything fits there."""
        p = self._parameters
        if not self._votes or self._votes[-1].id != keyframe.id:
            return None
        newest = self._votes[-1]
        same = [
            v
            for v in self._votes
            if self._agree(self._carried(v, keyframe), newest.pose, newest.travelled - v.travelled)
        ]
        told = self._prior is not None and self._prior.covers(newest.pose, keyframe.pose)
        needed = p.votes_known if told else p.votes
        if len(same) < needed or len(self._votes) - len(same) > p.dissent * len(same):
            return None
        if newest.travelled - same[0].travelled < (0.5 * p.patch if told else p.patch):
            return None
        points = thinned(self._patch(keyframe, p.window), 2 * p.points)
        match = self._fit(points, newest.pose, 2)
        if not self._fits(match, p.min_inliers_window) or not self._agree(match.pose, newest.pose, p.window):
            return None
        self.agreeing = same
        return Place(keyframe.id, match.pose, match, newest.log_odds, newest.lead, keyframe.travelled)

    def _carried(self, place: Place, keyframe: SessionKeyframe) -> FloatArray:
        """Where a place of an earlier keyframe puts this one, by the session's odometry, shape (4,)."""
        earlier = next(k for k in self._session if k.id == place.id)
        return carried(place.pose, earlier.pose, keyframe.pose)

    def _agree(self, a: FloatArray, b: FloatArray, way: float) -> bool:
        p = self._parameters
        turn = abs(float(geometry.wrap_angle(a[YAW] - b[YAW])))
        return bool(np.hypot(*(a[:2] - b[:2])) <= p.agreement + p.drift * way) and turn <= np.deg2rad(
            p.agreement_yaw_deg
        )

    def _patch(self, keyframe: SessionKeyframe, way: float) -> FloatArray:
        """Touches of the last metres, in the keyframe's level frame, shape (m, 3)."""
        parts = []
        for other in reversed(self._session):
            if keyframe.travelled - other.travelled > way:
                break
            parts.append(placed(other.points, relative(keyframe.pose, other.pose)))
        return np.concatenate(parts)


def relative(a: FloatArray, b: FloatArray) -> FloatArray:
    """Pose b (x, y, yaw, z) seen from pose a, both level."""
    return np.append(geometry.se2_compose(geometry.se2_inverse(a[:3]), b[:3]), b[3] - a[3])


def carried(place: FloatArray, earlier: FloatArray, later: FloatArray) -> FloatArray:
    """A place of the earlier pose, moved along by the way from there to the later one; each x, y, yaw, z."""
    step = relative(earlier, later)
    return np.append(geometry.se2_compose(place[:3], step[:3]), place[3] + step[3])


def thinned(points: FloatArray, count: int) -> FloatArray:
    """About `count` of the points, evenly along their order."""
    if len(points) <= count:
        return points
    return points[np.linspace(0, len(points) - 1, count).astype(np.int64)]
