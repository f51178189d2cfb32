"""Whether the robot can still be where it is thought to be, or has been carried away.

Two signs: the ground under the whiskers ceased to be that of a moment ago (a break), and the map contradicts
keyframes where it knows the ground. A break with contradictions means carried away. Contradictions alone may be
flooded or changed ground: they only cause a second opinion, a search of the whole map for what is touched now.
"""

from __future__ import annotations

from robominer_slam.configuration.relocalisation_section import RelocalisationSection
from robominer_slam.slam.keyframe import Keyframe
from robominer_slam.slam.surface_registration import SurfaceMatch


class Doubts:
    """Takes each keyframe with how it fits the map; a keyframe that fits ends all doubt.

    Attributes:
        contradictions: keyframes that did not fit, since the last that did.
        broken: whether there was a break since then.
    """

    def __init__(self, parameters: RelocalisationSection) -> None:
        self._parameters = parameters
        self._breaks: int | None = None
        self._age = 0
        self.contradictions = 0
        self.broken = False

    def judge(self, keyframe: Keyframe, match: SurfaceMatch | None, closed: bool = False) -> None:
        """Take a keyframe.

        Args:
            keyframe: the newest.
            match: of its touches where it is thought to be; None where the map knows nothing there.
            closed: whether a loop closure has just confirmed the place.
        """
        p = self._parameters
        self._age += 1
        if self._breaks is not None and keyframe.breaks > self._breaks:
            self.broken, self._age = True, 0
        self._breaks = keyframe.breaks
        if closed:
            self.clear()
        elif match is not None and match.overlap >= p.min_overlap_tracking:
            if match.inliers >= p.min_inliers:
                self.clear()
            elif match.inliers < p.max_inliers_contradiction:
                self.contradictions += 1
        if self.any and self._age > p.patience:
            self.clear()
        if not self.any:
            self._age = 0

    def clear(self) -> None:
        """The place has been confirmed, or doubt has lasted too long to mean anything."""
        self.contradictions, self.broken, self._age = 0, False, 0

    @property
    def any(self) -> bool:
        """Whether a second opinion is wanted."""
        return self.broken or self.contradictions > 0

    @property
    def serious(self) -> bool:
        """Whether the place should not be told as known while the doubt lasts."""
        return self.broken and self.contradictions > 0

    @property
    def carried_away(self) -> bool:
        """Whether the robot cannot be where it is thought to be."""
        return self.broken and self.contradictions >= self._parameters.contradictions
