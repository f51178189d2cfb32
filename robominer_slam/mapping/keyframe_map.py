"""The map as a set of keyframes: poses that the back-end corrects, points that stay in their own frame.

Where the back-end bounds the map, keyframes leave, hand their points to a neighbour, or have none of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.composite_scan import voxel_filter
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe
from robominer_slam.slam.saved_map import SavedMap

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MapKeyframe:
    """A keyframe in the map: its points, shape (m, 3), float32, m, in base_link at its time."""

    id: int
    stamp_ns: int
    points: NDArray[np.float32]


class KeyframeMap:
    """Keyframes, their poses in map, and the graph's edges.

    Args:
        point_voxel: points of a keyframe closer than this are one, m.

    Attributes:
        version: grows whenever something changed.
        keyframes: in the order of their ids; some ids are missing where the back-end has taken keyframes out.
        poses: of them, shape (n, 4, 4).
        edges: between them.
        closures: number of loop closures among these.
    """

    def __init__(self, point_voxel: float) -> None:
        self._voxel = point_voxel
        self.version = 0
        self.keyframes: list[MapKeyframe] = []
        self.poses: FloatArray = np.zeros((0, 4, 4))
        self.edges: Sequence[GraphEdge] = ()
        self.closures = 0

    def take(self, result: BackendResult) -> None:
        """Take a result of the back-end: new keyframes, poses for all, what has gone or lost its points."""
        self.keyframes += [self._thinned(keyframe) for keyframe in result.new_keyframes]
        if result.removed or result.bare:
            self._let_go(result)
        self.poses = result.poses
        self.edges = result.edges
        self.closures = sum(edge.kind == "loop" for edge in self.edges)
        self.version += 1

    def load(self, saved: SavedMap) -> None:
        """Start with a map that was saved."""
        self.keyframes = [self._thinned(keyframe) for keyframe in saved.keyframes]
        self.poses = saved.poses
        self.edges = saved.edges
        self.closures = sum(edge.kind == "loop" for edge in self.edges)
        self.version += 1

    def clear(self) -> None:
        """Start anew; the version goes on, so that nobody takes the new map for the old one."""
        self.keyframes = []
        self.poses = np.zeros((0, 4, 4))
        self.edges = ()
        self.closures = 0
        self.version += 1

    @property
    def ids(self) -> list[int]:
        """Of the keyframes, growing, in the order of the poses."""
        return [keyframe.id for keyframe in self.keyframes]

    def cloud(self) -> FloatArray:
        """All points in map, shape (m, 3), m."""
        parts = [
            geometry.transform_points(T, keyframe.points)
            for T, keyframe in zip(self.poses, self.keyframes, strict=True)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3))

    def _let_go(self, result: BackendResult) -> None:
        """Points to neighbours, then keyframes out."""
        by_id = {keyframe.id: keyframe for keyframe in self.keyframes}
        for merge in result.merged:
            into, moved = by_id[merge.into], geometry.transform_points(merge.T_into_gone, by_id[merge.gone].points)
            points = np.concatenate([into.points, moved]).astype(np.float64)
            points = voxel_filter(points, max(merge.voxel, self._voxel))
            by_id[merge.into] = replace(into, points=points.astype(np.float32))
        for key in result.bare:
            by_id[key] = replace(by_id[key], points=np.zeros((0, 3), dtype=np.float32))
        for key in result.removed:
            del by_id[key]
        self.keyframes = list(by_id.values())

    def _thinned(self, keyframe: Keyframe) -> MapKeyframe:
        points = voxel_filter(keyframe.points, self._voxel)
        return MapKeyframe(keyframe.id, keyframe.stamp_ns, points.astype(np.float32))
