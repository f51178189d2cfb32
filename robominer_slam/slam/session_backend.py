"""A session's own graph, which can be joined to a map that was known before."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.closure_search import Closure
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.slam.keyframe_edges import loop_edge
from robominer_slam.slam.level_edges import LevelEdge
from robominer_slam.slam.level_map import LevelMap
from robominer_slam.slam.patch import Patch
from robominer_slam.slam.robust import RobustBackend
from robominer_slam.slam.surface import Surface, SurfaceModel
from robominer_slam.slam.surface_registration import SurfaceMatch, fit, placed

FloatArray = NDArray[np.float64]

#: Ways between what the known map was driven for and the session's, m: its ground is old to any closure search.
FAR = 1000.0
#: Touches and planes of the look whether a keyframe fits where it is thought to be.
LOOK_POINTS = 200


class SessionBackend(RobustBackend):
    """The method's back-end, from an empty graph on.

    Attributes:
        bounded: whether keyframes and touches may go; not while it is in doubt which of them are the map's.
    """

    bounded = True

    @property
    def ids(self) -> tuple[int, ...]:
        """Of all keyframes in the graph."""
        return tuple(self._graph.nodes.ids.tolist())

    def pose(self, k: int) -> FloatArray:
        """x, y, heading, z of a keyframe, shape (4,), m and rad."""
        return np.append(self._graph.nodes[k], self._graph.nodes.height(k))

    def level_map(self) -> LevelMap:
        """The graph as a known map; all its touches come into memory."""
        nodes, edges = self._graph.nodes, self._graph.edges
        ids = nodes.ids.tolist()
        return LevelMap(
            dict(zip(ids, nodes.poses.copy(), strict=True)),
            dict(zip(ids, nodes.heights.tolist(), strict=True)),
            dict(zip(ids, nodes.tilts.copy(), strict=True)),
            dict(zip(ids, nodes.travelled.tolist(), strict=True)),
            {k: self._patches[k] for k in ids if k in self._patches},
            [edges.edge(row) for row in range(len(edges))],
        )

    def adopt(self, known: LevelMap, origin: FloatArray, ties: Sequence[Closure]) -> None:
        """Join the session to a known map, and optimise both.

        Args:
            known: the map; its ids lie below the session's.
            origin: of the session's frame in map, x, y, heading, z, shape (4,).
            ties: closures from the session's keyframes to the map's.
        """
        graph, nodes = self._graph, self._graph.nodes
        nodes.poses[:] = geometry.se2_compose(origin[:3], nodes.poses)
        nodes.heights[:] += float(origin[3])
        begin = float(nodes.travelled[0]) if len(nodes) else 0.0
        shift = begin - FAR - max(known.travelled.values(), default=0.0)
        nodes.put_before(known.nodes(shift))
        for k, patch in known.patches.items():
            self._patches[k] = Patch(patch.points, patch.travelled + shift, patch.walls)
        nb = graph.bias.size
        for edge in known.edges:
            graph.edges.append(_with_biases(edge, nb))
        for tie in ties:
            graph.edges.append(loop_edge(tie, nb))
        self.closures.counts["accepted"] += len(ties)
        self._closed = max((tie.j for tie in ties), default=self._closed)
        self._recent = list(ties)
        self._map.joined(self._parameters.keyframe_distance)
        self._since_full = 0
        self._optimise_whole()
        self._tracked.forget()
        if self._last is not None:
            self._covariance = self._tracked.of_newest()

    def _bound(self, newest: int, load: int) -> None:
        if self.bounded:
            super()._bound(newest, load)

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
        nodes, p = self._graph.nodes, self._parameters.closure
        k = keyframe.id
        points = self._patches[k].points
        near = nodes.mapped & (np.hypot(*(nodes.poses[:, :2] - nodes[k][:2]).T) <= p.target_radius)
        near &= (
            nodes.travelled <= keyframe.travelled - p.min_travel
            if recent is None
            else ~np.isin(nodes.ids, np.fromiter(recent, dtype=np.int64))
        )
        old = nodes.ids[near].tolist()
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
