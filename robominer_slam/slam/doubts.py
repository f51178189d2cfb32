"""Whether the robot can still be where it is thought to be, or has been carried away.

Two signs: the ground under the whiskers ceased to be that of a moment ago (a break), and the map contradicts
keyframes where it knows the ground. A break with contradictions, or one that nothing explains for long, means
carried away. Contradictions alone may be flooded or changed ground: they only cause a second opinion, a search of
the whole map for what is touched now.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.relocalisation_section import RelocalisationSection
from robominer_slam.slam.keyframe import Keyframe
from robominer_slam.slam.surface_registration import SurfaceMatch

#: A place that may be as far off as a second opinion would be, by so many sigmas, is not contradicted by its ground.
UNSURE_SIGMAS = 2.0
#: Keyframes in a row that must fit ground with relief before a break is taken for explained.
FITTING_AFTER_BREAK = 3


class Doubts:
    """Takes each keyframe with how it fits the map; one that fits ends the doubt, after a break several must.

    Attributes:
        contradictions: keyframes that did not fit, since the last that did.
        broken: whether there was a break since then.
    """

    def __init__(self, parameters: RelocalisationSection) -> None:
        self._parameters = parameters
        self._breaks: int | None = None
        self._age = self._fitting = 0
        self.contradictions = 0
        self.broken = False

    def notice(self, keyframe: Keyframe) -> None:
        """Take the next keyframe: has the ground broken off?"""
        self._age += 1
        if self._breaks is not None and keyframe.breaks > self._breaks:
            self.broken, self._age, self._fitting = True, 0, 0
        self._breaks = keyframe.breaks

    def are_sensible(self, covariance: NDArray[np.float64]) -> bool:
        """Whether ground that does not fit would tell anything; without a break not where the place is unsure anyway.

        Args:
            covariance: of x, y (m) and heading in map, shape (3, 3).
        """
        sigma = math.sqrt(max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0))
        return self.broken or UNSURE_SIGMAS * sigma <= self._parameters.elsewhere

    def judge(self, match: SurfaceMatch | None, closed: bool = False) -> None:
        """Take how that keyframe fits the map.

        Args:
            match: of its touches where it is thought to be; None where the map knows nothing there.
            closed: whether a loop closure has just confirmed the place.
        """
        p = self._parameters
        if closed:
            self._confirmed(1)
        elif match is not None and match.overlap >= p.min_overlap_tracking:
            if match.inliers >= p.min_inliers:
                self._confirmed(int(match.relief >= p.min_contrast * match.rms))
            elif match.inliers < p.max_inliers_contradiction:
                self.contradictions += 1
                self._fitting = 0
        if self.contradictions and not self.broken and self._age > p.patience:
            self.clear()
        if not self.any:
            self._age = 0

    def _confirmed(self, weight: int) -> None:
        # After a break one keyframe may fit by chance, or by what was touched before.
        self._fitting += weight
        if not self.broken or self._fitting >= FITTING_AFTER_BREAK:
            self.clear()

    def clear(self) -> None:
        """The place has been confirmed, or doubt has lasted too long to mean anything."""
        self.contradictions, self.broken, self._age, self._fitting = 0, False, 0, 0

    @property
    def any(self) -> bool:
        """Whether a second opinion is wanted."""
        return self.broken or self.contradictions > 0

    @property
    def carried_away(self) -> bool:
        """Whether the robot cannot be where it is thought to be."""
        p = self._parameters
        return self.broken and (self.contradictions >= p.contradictions or self._age >= p.patience)
