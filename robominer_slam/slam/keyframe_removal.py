"""Takes keyframes out of a graph without making it surer of anything.

The odometry edges on both sides of a keyframe become one: with Z_1, Z_2 taken at the present biases b,

    Z = Z_1 Z_2,   Sigma = Ad Sigma_1 Ad' + Sigma_2,   B = Ad B_1 + B_2,   Ad = Ad(Z_2^-1),

which is exactly what marginalising a keyframe without other edges leaves. Its loop edges are dropped: information
is lost, and none is counted twice. Where loop edges go, the bridge is laid where the keyframes lie now (Z is their
present relative pose): what the loops knew is no longer counted, but the map keeps the shape that they gave it.

Sources: Forster et al., "On-manifold preintegration" (T-RO 2017), for composed edges; Kretzschmar and Stachniss,
"Information-theoretic compression of pose graphs" (IJRR 2012), for which keyframes to let go: those that tell the map
least, here those whose ground it had before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from robominer_slam import geometry
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.level_edges import LevelEdge

FloatArray = NDArray[np.float64]


def composed(first: LevelEdge, second: LevelEdge, bias: FloatArray) -> LevelEdge:
    """One odometry edge from the start of the first to the end of the second, as of `bias`, shape (nb,)."""
    Z_1, Z_2 = (geometry.se2_compose(e.Z, geometry.se2_exp(e.jacobian @ (bias - e.reference))) for e in (first, second))
    Ad = geometry.se2_adjoint(geometry.se2_inverse(Z_2))
    covariance = Ad @ np.linalg.inv(first.information) @ Ad.T + np.linalg.inv(second.information)
    information = np.linalg.inv(covariance)
    return LevelEdge(
        "odometry",
        first.i,
        second.j,
        geometry.se2_compose(Z_1, Z_2),
        0.5 * (information + information.T),
        first.dz + second.dz,
        1.0 / (1.0 / first.dz_information + 1.0 / second.dz_information),
        Ad @ first.jacobian + second.jacobian,
        bias.copy(),
        fade=min(first.fade, second.fade),
        slack=Ad @ _slack(first) @ Ad.T + _slack(second),
    )


def _slack(edge: LevelEdge) -> FloatArray:
    return np.zeros((3, 3)) if edge.slack is None else edge.slack


def remove_keyframes(graph: KeyframeGraph, keys: list[int]) -> list[LevelEdge]:
    """Take keyframes, neither the first nor the last, out of a graph.

    Returns:
        The odometry edges that now bridge where they were.
    """
    edges = graph.edges
    gone = np.isin(edges.i, keys) | np.isin(edges.j, keys)
    odometry = np.flatnonzero(gone & ~edges.loop)
    odometry = odometry[np.argsort(edges.j[odometry], kind="stable")]
    bridges: list[LevelEdge] = []
    removed = set(keys)
    for row in odometry:
        edge = edges.edge(int(row))
        if bridges and bridges[-1].j == edge.i and edge.i in removed:
            bridges[-1] = composed(bridges[-1], edge, graph.bias)
        else:
            bridges.append(edge)
    if any(bridge.i in removed or bridge.j in removed for bridge in bridges):
        raise ValueError("the first and the last keyframe of a graph cannot be taken out of it")
    tied = set(edges.i[gone & edges.loop].tolist()) | set(edges.j[gone & edges.loop].tolist())
    ids = graph.nodes.ids
    for place, bridge in enumerate(bridges):
        between = ids[(ids > bridge.i) & (ids < bridge.j)].tolist()
        if tied & set(between):
            dz = graph.nodes.height(bridge.j) - graph.nodes.height(bridge.i)
            bridges[place] = replace(bridge, Z=graph.relative(bridge.i, bridge.j), dz=dz)
    edges.keep(~gone)
    for bridge in bridges:
        edges.append(bridge)
    graph.nodes.remove(keys)
    graph.update_chi2()
    return bridges


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

    Those at the ends of a session's odometry, which no edge could bridge, and between sessions that only closures
    tie, as many of these as tie them all.
    """
    nodes, edges = graph.nodes, graph.edges
    stays = np.ones(len(nodes), dtype=np.bool_)
    if not len(edges):
        return stays
    i, j = nodes.rows(edges.i), nodes.rows(edges.j)
    steps = ~edges.loop
    begins, ends = np.zeros(len(nodes), dtype=np.bool_), np.zeros(len(nodes), dtype=np.bool_)
    begins[i[steps]], ends[j[steps]] = True, True
    stays = ~(begins & ends)
    links = coo_matrix((np.ones(steps.sum()), (i[steps], j[steps])), shape=(len(nodes), len(nodes)))
    count, part = connected_components(links, directed=False)
    for row in np.flatnonzero(edges.loop & edges.enabled):
        if count == 1:
            break
        one, other = part[i[row]], part[j[row]]
        if one != other:
            part[part == other] = one
            stays[[i[row], j[row]]] = True
            count -= 1
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
