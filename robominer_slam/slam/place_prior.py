"""What the operator says of the robot's place: a guess to begin with, never a proof."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry

FloatArray = NDArray[np.float64]

#: Guesses over the prior: rings of headings at its centre, and its rim.
RIM = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
HEADINGS = (-1.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class PlacePrior:
    """A place with its uncertainty.

    Attributes:
        x, y, yaw: of base_link in map, m and rad.
        sigma: of x and of y, m.
        sigma_yaw: rad.
        keyframe: id of the session's keyframe that was made there; None before there is one.
        session_pose: x, y, yaw, z of that keyframe in its session's frame, shape (4,).
    """

    x: float
    y: float
    yaw: float
    sigma: float
    sigma_yaw: float
    keyframe: int | None = None
    session_pose: FloatArray | None = None

    def at(self, keyframe: int, session_pose: FloatArray) -> PlacePrior:
        """The same, tied to the keyframe that was made there."""
        return replace(self, keyframe=keyframe, session_pose=session_pose)

    def mean(self, session_pose: FloatArray) -> FloatArray:
        """Where it puts a later keyframe of the session: x, y, yaw, shape (3,)."""
        place = np.array([self.x, self.y, self.yaw])
        if self.session_pose is None:
            return place
        step = geometry.se2_compose(geometry.se2_inverse(self.session_pose[:3]), session_pose[:3])
        return geometry.se2_compose(place, step)

    def guesses(self, session_pose: FloatArray) -> list[FloatArray]:
        """Poses (x, y, yaw, z) over the prior, to refine from."""
        centre = self.mean(session_pose)
        return [
            np.array([centre[0] + a * self.sigma, centre[1] + b * self.sigma, centre[2] + h * self.sigma_yaw, 0.0])
            for a, b in RIM
            for h in HEADINGS
        ]

    def covers(self, pose: FloatArray, session_pose: FloatArray) -> bool:
        """Whether a pose of the session's keyframe (x, y, yaw, ...) is within three sigmas of it."""
        off = pose[:3] - self.mean(session_pose)
        turn = abs(float(geometry.wrap_angle(off[2])))
        return bool(np.hypot(off[0], off[1]) <= 3.0 * self.sigma + 0.05) and turn <= 3.0 * self.sigma_yaw
