"""Keyframes, edges of the pose graph, and what the back-end hands back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

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
        searched: whether loop closures are to be searched for it; not where the computer cannot keep up.
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
    searched: bool = True

    @property
    def floor_points(self) -> FloatArray:
        """The points of whiskers that point down: heights over the plane are the floor's, walls have none."""
        return self.points if self.floor is None else self.points[self.floor]

    @property
    def wall_points(self) -> FloatArray:
        """Touches of the whiskers that do not, shape (m, 3), m."""
        return self.points[:0] if self.floor is None else self.points[~self.floor]


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
class Merge:
    """A keyframe whose touches move into the frame of another before it goes.

    Attributes:
        gone, into: ids.
        T_into_gone: pose of the one in the other, shape (4, 4).
        voxel: touches closer than this become one, m.
    """

    gone: int
    into: int
    T_into_gone: FloatArray
    voxel: float


@dataclass(frozen=True, slots=True)
class BackendResult:
    """The graph after a keyframe was taken in.

    Attributes:
        keyframe: the one that was taken in.
        T_map_odom: correction that holds from its effect on, shape (4, 4).
        poses: of all keyframes that are in the graph, in map, in the order of their ids, shape (n, 4, 4).
        covariance: of the keyframe's (x, y, yaw) in map, shape (3, 3).
        edges: of the whole graph.
        closures: loop closures added by this keyframe.
        version: grows by one with each result.
        entered: keyframes that are new in the map; None for just `keyframe`. While the place in the map is not
            known there are none, and all that were made meanwhile enter together when it is.
        ids: of the keyframes that `poses` are of; None for 0, 1, 2, ...
        localised: whether the keyframe's place in the map is known.
        added: edges that were not in the result before; None where the back-end does not say.
        dropped: pairs (i, j) of keyframes whose loop closures have left the graph though both stay; `added` may have
            one that takes their place.
        removed: ids of keyframes that have left the graph with all their edges.
        merged: which of these hand their touches to a neighbour, in order.
        bare: ids of keyframes that keep no touches: the map has their ground from others.
        counts: what the back-end has counted so far, by name.
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
    added: Sequence[GraphEdge] | None = None
    dropped: Sequence[tuple[int, int]] = ()
    removed: Sequence[int] = ()
    merged: Sequence[Merge] = ()
    bare: Sequence[int] = ()
    counts: Mapping[str, int] = field(default_factory=dict)

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


@runtime_checkable
class ReleasesMemory(Protocol):
    """A back-end with memory that must be freed in the thread that made it."""

    def release(self) -> None:
        """Free it; the back-end is not used again."""
        ...
