"""Keyframes, edges of the pose graph, and what the back-end hands back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from robominer_slam.estimation.keyframe_motion import KeyframeMotion
from robominer_slam.slam.place_prior import PlacePrior

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A composite scan that became a node of the pose graph.

    Attributes:
        id: 0, 1, 2, ... in the order of creation.
        stamp_ns: time of the whisker frame that completed it.
        T_odom_base: pose of base_link in odom at that time, shape (4, 4).
        points: contact points in base_link at that time, shape (m, 3), m.
        travelled: distance driven by odometry up to here, m.
        floor: which points are of whiskers that point down, shape (m,); None where all are or nobody asks.
        motion: since the keyframe before, where the dead reckoning tells its noise and biases apart.
        breaks: how often so far the ground has ceased to be the one touched just before: carried, or fallen.
        prior: where the operator says that this keyframe is; the way from the keyframe before is then not known.
    """

    id: int
    stamp_ns: int
    T_odom_base: FloatArray
    points: FloatArray
    travelled: float
    motion: KeyframeMotion | None = None
    floor: NDArray[np.bool_] | None = None
    breaks: int = 0
    prior: PlacePrior | None = None

    @property
    def floor_points(self) -> FloatArray:
        """The points of whiskers that point down: heights over the plane are the floor's, walls have none."""
        return self.points if self.floor is None else self.points[self.floor]


@dataclass(frozen=True, slots=True)
class GraphEdge:
    """A constraint between keyframes i and j.

    Attributes:
        kind: of odometry or of a loop closure.
        T_i_j: pose of keyframe j in keyframe i, shape (4, 4).
        information: shape (6, 6), translation first.
        weight: what the robust kernel leaves of it, 0 to 1.
    """

    kind: Literal["odometry", "loop"]
    i: int
    j: int
    T_i_j: FloatArray
    information: FloatArray
    weight: float


@dataclass(frozen=True, slots=True)
class BackendResult:
    """The graph after a keyframe was taken in.

    Attributes:
        keyframe: the one that was taken in.
        T_map_odom: correction that holds from its effect on, shape (4, 4).
        poses: of all keyframes in map, shape (n, 4, 4).
        covariance: of the keyframe's (x, y, yaw) in map, shape (3, 3).
        edges: of the whole graph.
        closures: loop closures added by this keyframe.
        version: grows by one with each result.
        entered: keyframes that are new in the map; None for just `keyframe`. While the place in the map is not
            known there are none, and all that were made meanwhile enter together when it is.
        ids: of the keyframes that `poses` are of; None for 0, 1, 2, ...
        localised: whether the keyframe's place in the map is known.
    """

    keyframe: Keyframe
    T_map_odom: FloatArray
    poses: FloatArray
    covariance: FloatArray
    edges: Sequence[GraphEdge]
    closures: int
    version: int
    entered: tuple[Keyframe, ...] | None = None
    ids: tuple[int, ...] | None = None
    localised: bool = True

    @property
    def new_keyframes(self) -> tuple[Keyframe, ...]:
        """Keyframes that this result adds to the map."""
        return (self.keyframe,) if self.entered is None else self.entered

    @property
    def keyframe_ids(self) -> tuple[int, ...]:
        """Ids of the keyframes that `poses` are of."""
        return tuple(range(len(self.poses))) if self.ids is None else self.ids


class Backend(Protocol):
    """Takes keyframes one after the other; each result depends on those before it only."""

    def process(self, keyframe: Keyframe) -> BackendResult:
        """Add a keyframe, search for loop closures, optimise."""
        ...
