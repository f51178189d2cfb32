"""Takes keyframes out of a graph, and says which may go.

What the edges of a keyframe that goes know of the others stays as edges between these (`factor_recovery`).

Source: Kretzschmar and Stachniss, "Information-theoretic compression of pose graphs" (IJRR 2012), for which keyframes
to let go: those that tell the map least, here those whose ground it has from others.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.closure_leverage import ties
from robominer_slam.slam.factor_recovery import combined, recovered
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.level_edges import LevelEdge

FloatArray = NDArray[np.float64]


def remove_keyframes(graph: KeyframeGraph, keys: list[int]) -> list[LevelEdge]:
    """Take keyframes, neither the first nor the last, out of a graph.

    A closure that now stands for what was known already by closures of the same two keyframes takes their place.
    Squared errors of edges are not valid until `KeyframeGraph.update_chi2`: several calls can share it.

    Returns:
        The edges that say what was known of the others (`factor_recovery`).
    """
    edges = graph.edges
    found = recovered(graph, keys)
    edges.keep(~np.isin(edges.i, keys) & ~np.isin(edges.j, keys))
    for edge in found:
        if edge.kind == "loop":
            same = edges.loop & (edges.i == edge.i) & (edges.j == edge.j)
            for row in np.flatnonzero(same & edges.enabled).tolist():
                edge = combined(graph, edge, edges.edge(row))
            edges.keep(~same)
        edges.append(edge)
    graph.nodes.remove(keys)
    return found


def interior_of_covered(graph: KeyframeGraph, window: int, tie_spacing: int) -> list[int]:
    """Keyframes that may go first, oldest first: without touches in the map, between two such.

    Those at the ends of covered stretches stay, and one in `tie_spacing` within: their closures tie together what was
    mapped at different times.

    Args:
        graph: the graph.
        window: keyframes at the end that stay.
        tie_spacing: by ids.
    """
    bare = ~graph.nodes.mapped
    interior = bare.copy()
    interior[1:] &= bare[:-1]
    interior[:-1] &= bare[1:]
    interior &= graph.nodes.ids % tie_spacing != 0
    return _removable(graph, interior, window)


def covered(graph: KeyframeGraph, window: int) -> list[int]:
    """All keyframes without touches in the map, oldest first, but for the first and the last `window`."""
    return _removable(graph, ~graph.nodes.mapped, window)


def farthest(graph: KeyframeGraph, window: int, robot: FloatArray) -> list[int]:
    """Keyframes but for the first and the last `window`, farthest from the robot (x, y), shape (2,), m, first."""
    keys = _removable(graph, np.ones(len(graph.nodes), dtype=np.bool_), window)
    distance = np.hypot(*(graph.nodes.poses[graph.nodes.rows(keys), :2] - robot).T)
    return [keys[k] for k in np.argsort(-distance, kind="stable")]


def pinned(graph: KeyframeGraph) -> NDArray[np.bool_]:
    """Keyframes that hold the graph together, shape (n,): they stay.

    Those at the ends of a session's odometry, which no edge could bridge, and those that `ties` joins.
    """
    nodes, edges = graph.nodes, graph.edges
    if not len(edges):
        return np.ones(len(nodes), dtype=np.bool_)
    i, j = nodes.rows(edges.i), nodes.rows(edges.j)
    begins, ends = np.zeros(len(nodes), dtype=np.bool_), np.zeros(len(nodes), dtype=np.bool_)
    begins[i[~edges.loop]], ends[j[~edges.loop]] = True, True
    stays: NDArray[np.bool_] = ~(begins & ends)
    rows = ties(graph)
    stays[i[rows]] = stays[j[rows]] = True
    return stays


def mergeable(
    graph: KeyframeGraph, spans: Mapping[int, float], extent: float, window: int, robot: FloatArray
) -> list[int]:
    """Keyframes that may be merged into the one before them, farthest from the robot first; no two neighbours.

    Args:
        graph: the graph.
        spans: way from a keyframe to the last one that was merged into it, by id, m; 0 where not named.
        extent: way that a merged keyframe may span, m.
        window: keyframes at the end that stay.
        robot: x and y of the robot, shape (2,), m.
    """
    nodes = graph.nodes
    last = len(nodes) - window
    if last < 3:
        return []
    own = np.array([spans.get(int(k), 0.0) for k in nodes.ids[1:last]])
    both = nodes.mapped[1:last] & nodes.mapped[: last - 1]
    possible = both & (np.diff(nodes.travelled[:last]) + own <= extent) & ~pinned(graph)[1:last]
    distance = np.hypot(*(nodes.poses[1:last, :2] - robot).T)
    chosen: list[int] = []
    taken = np.zeros(last + 1, dtype=np.bool_)
    for place in np.argsort(-distance, kind="stable"):
        row = int(place) + 1
        if possible[place] and not taken[row - 1 : row + 2].any():
            taken[row] = True
            chosen.append(int(nodes.ids[row]))
    return chosen


def _removable(graph: KeyframeGraph, which: NDArray[np.bool_], window: int) -> list[int]:
    which = which & ~pinned(graph)
    which[[0, -1]] = False
    which[max(1, len(which) - window) :] = False
    return [int(k) for k in graph.nodes.ids[which]]
