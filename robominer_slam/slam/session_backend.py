"""A session's own graph, which can be joined to a map that was known before."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.closure_search import Closure, Patch
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.slam.keyframe_graph import LevelEdge
from robominer_slam.slam.level_map import LevelMap
from robominer_slam.slam.robust import RobustBackend
from robominer_slam.slam.surface import Surface, SurfaceModel
from robominer_slam.slam.surface_registration import SurfaceMatch, fit, placed

FloatArray = NDArray[np.float64]

#: Ways between what the known map was driven for and the session's, m: its ground is old to any closure search.
FAR = 1000.0
#: Touches and planes of the look whether a keyframe fits where it is thought to be.
LOOK_POINTS = 200


class SessionBackend(RobustBackend):
    """The method's back-end, from an empty graph on."""

    @property
    def ids(self) -> tuple[int, ...]:
        """Of all keyframes in the graph."""
        return tuple(sorted(self._graph.poses))

    def pose(self, k: int) -> FloatArray:
        """x, y, heading, z of a keyframe, shape (4,), m and rad."""
        return np.append(self._graph.poses[k], self._graph.heights[k])

    def level_map(self) -> LevelMap:
        """The graph as a known map."""
        graph = self._graph
        return LevelMap(
            dict(graph.poses), dict(graph.heights), dict(self._tilts), dict(self._patches), list(graph.edges)
        )

    def adopt(self, known: LevelMap, origin: FloatArray, ties: Sequence[Closure]) -> None:
        """Join the session to a known map, and optimise both.

        Args:
            known: the map; its ids lie below the session's.
            origin: of the session's frame in map, x, y, heading, z, shape (4,).
            ties: closures from the session's keyframes to the map's.
        """
        graph = self._graph
        for k in graph.poses:
            graph.poses[k] = geometry.se2_compose(origin[:3], graph.poses[k])
            graph.heights[k] += float(origin[3])
        begin = min((p.travelled for p in self._patches.values()), default=0.0)
        end = max((p.travelled for p in known.patches.values()), default=0.0)
        shift = begin - FAR - end
        graph.poses.update(known.poses)
        graph.heights.update(known.heights)
        self._tilts.update(known.tilts)
        self._patches.update({k: Patch(p.points, p.travelled + shift) for k, p in known.patches.items()})
        nb = graph.bias.size
        graph.edges[:0] = [_with_biases(edge, nb) for edge in known.edges]
        for tie in ties:
            self._add_loop(tie)
        self._recent = list(ties)
        self._optimise()
        if self._last is not None:
            self._update_covariance(self._last.id)

    def present(self, keyframe: Keyframe, closures: int) -> BackendResult:
        """The result as it is now, of the newest keyframe."""
        return self._result(keyframe, closures)

    def look(
        self, keyframe: Keyframe, model: SurfaceModel, recent: Collection[int] | None = None
    ) -> SurfaceMatch | None:
        """How the newest keyframe fits the ground touched before, where it is thought to be; None without any.

        Args:
            keyframe: the newest.
            model: how touches make a surface.
            recent: ids of keyframes whose ground does not count; None for those of the closures' least travel.
        """
        graph, p = self._graph, self._parameters.closure
        k = keyframe.id
        points = self._patches[k].points
        old = [
            i for i, patch in self._patches.items()
            if (patch.travelled <= keyframe.travelled - p.min_travel if recent is None else i not in recent)
            and np.hypot(*(graph.poses[i][:2] - graph.poses[k][:2])) <= p.target_radius
        ]  # fmt: skip
        if not old or len(points) < LOOK_POINTS // 4:
            return None
        ground = np.concatenate([placed(self._patches[i].points, self.pose(i)) for i in old])
        points = points[np.linspace(0, len(points) - 1, LOOK_POINTS).astype(np.int64)]
        prior = np.diag([1.0 / 0.05**2, 1.0 / 0.05**2, 1.0 / 0.05**2, 1.0 / 0.02**2])
        return fit(Surface(ground, model), points, self.pose(k), prior, 2)


def _with_biases(edge: LevelEdge, nb: int) -> LevelEdge:
    if edge.jacobian.shape[1] == nb:
        return edge
    return replace(edge, jacobian=np.zeros((3, nb)), reference=np.zeros(nb))
