"""The level graph's edges as they are published: made once each, not at every keyframe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.keyframe import GraphEdge
from robominer_slam.slam.keyframe_nodes import KeyframeNodes
from robominer_slam.slam.level_edges import LevelEdges

FloatArray = NDArray[np.float64]

PLANAR = [0, 1, 5]
#: What gravity leaves open of roll and pitch, rad.
TILT_SIGMA = 0.005


class PublishedEdges:
    """Follows the edges of a graph.

    Attributes:
        edges: all of them, in the graph's order.
        added: those that the last `follow` found new.
        dropped: pairs of keyframes, both still there, whose closures the last `follow` missed.
    """

    def __init__(self) -> None:
        self.edges: list[GraphEdge] = []
        self.added: list[GraphEdge] = []
        self.dropped: list[tuple[int, int]] = []
        self._serials = np.zeros(0, dtype=np.int64)
        self._enabled = np.zeros(0, dtype=np.bool_)

    def follow(self, edges: LevelEdges, nodes: KeyframeNodes) -> None:
        """Take the graph as it is now."""
        self.added, self.dropped = [], []
        if not len(edges):
            return
        serials, enabled = edges.serial, edges.enabled
        if not np.array_equal(serials[: len(self._serials)], self._serials):
            stays = np.isin(self._serials, serials)
            ends = (self.edges[k] for k in np.flatnonzero(~stays))
            self.dropped = [(edge.i, edge.j) for edge in ends if edge.i in nodes and edge.j in nodes]
            self.edges = [self.edges[k] for k in np.flatnonzero(stays)]
            self._enabled = self._enabled[stays]
        known = len(self.edges)
        for row in np.flatnonzero(enabled[:known] != self._enabled):
            old = self.edges[row]
            self.edges[row] = GraphEdge(old.kind, old.i, old.j, old.T_i_j, old.information, float(enabled[row]))
        self.added = [published(edges, nodes, row) for row in range(known, len(edges))]
        self.edges += self.added
        self._serials, self._enabled = serials.copy(), enabled.copy()


def published(edges: LevelEdges, nodes: KeyframeNodes, row: int) -> GraphEdge:
    """One edge, from level frames to the keyframes' own."""
    edge = edges.edge(row)
    T = geometry.T_from_xyyaw(edge.Z)
    T[2, 3] = edge.dz
    R_i, R_j = np.eye(4), np.eye(4)
    R_i[:3, :3], R_j[:3, :3] = nodes.tilt(edge.i), nodes.tilt(edge.j)
    information = np.diag([0.0, 0.0, edge.dz_information, TILT_SIGMA**-2, TILT_SIGMA**-2, 0.0])
    information[np.ix_(PLANAR, PLANAR)] = edge.information
    return GraphEdge(edge.kind, edge.i, edge.j, R_i.T @ T @ R_j, information, float(edges.enabled[row]))
