"""The map as a set of keyframes: poses that the back-end corrects, points that never change in their own frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    """

    def __init__(self, point_voxel: float) -> None:
        self._voxel = point_voxel
        self.version = 0
        self.keyframes: list[MapKeyframe] = []
        self.poses: FloatArray = np.zeros((0, 4, 4))
        self.edges: Sequence[GraphEdge] = ()

    def take(self, result: BackendResult) -> None:
        """Take a result of the back-end: new keyframes, and poses for all."""
        self.keyframes += [self._thinned(keyframe) for keyframe in result.new_keyframes]
        self.poses = result.poses
        self.edges = result.edges
        self.version += 1

    def load(self, saved: SavedMap) -> None:
        """Start with a map that was saved."""
        self.keyframes = [self._thinned(keyframe) for keyframe in saved.keyframes]
        self.poses = saved.poses
        self.edges = saved.edges
        self.version += 1

    def clear(self) -> None:
        """Start anew; the version goes on, so that nobody takes the new map for the old one."""
        self.keyframes = []
        self.poses = np.zeros((0, 4, 4))
        self.edges = ()
        self.version += 1

    @property
    def ids(self) -> list[int]:
        """Of the keyframes, in the order of the poses."""
        return [keyframe.id for keyframe in self.keyframes]

    @property
    def closures(self) -> int:
        """Number of loop closures in the graph."""
        return sum(edge.kind == "loop" for edge in self.edges)

    def cloud(self) -> FloatArray:
        """All points in map, shape (m, 3), m."""
        parts = [
            geometry.transform_points(T, keyframe.points)
            for T, keyframe in zip(self.poses, self.keyframes, strict=True)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3))

    def _thinned(self, keyframe: Keyframe) -> MapKeyframe:
        points = voxel_filter(keyframe.points, self._voxel)
        return MapKeyframe(keyframe.id, keyframe.stamp_ns, points.astype(np.float32))
