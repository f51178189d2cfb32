"""Which closures a graph can do without: those that say little of the way between their keyframes.

The leverage of an edge with the information Omega is tr(Omega M) / 3, with M the covariance of its relative pose in the
whole graph: the share of what is known there that comes from the edge itself. It is 1 where nothing else ties the two,
and near 0 where others know it far better. Without the edge, that covariance grows by 1 / (1 - leverage) or so.

Source: Cook, "Detection of influential observation in linear regression" (Technometrics 1977), for leverage; M from
random draws (`pose_graph_covariance`), since ranks need no digits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from robominer_slam import geometry
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.pose_graph_covariance import sampled_relative_covariances
from robominer_slam.slam.pose_graph_residuals import EdgeArrays

FloatArray = NDArray[np.float64]

#: Random draws: a leverage is off by a fifth of itself.
DRAWS = 48
#: Closures of more leverage are never let go.
NEEDED = 0.5


def leverages(graph: KeyframeGraph) -> FloatArray:
    """Leverage of each edge, shape (m,), 0 for those taken back; biases as known."""
    problem, system, kernels = graph.problem()
    arrays = EdgeArrays(2, problem.i, problem.j, geometry.se2_inverse(problem.Z), problem.information)
    pairs = np.stack([problem.i, problem.j], axis=1)
    M = sampled_relative_covariances(arrays, kernels, graph.nodes.poses, system, pairs, DRAWS, 0)
    found = np.zeros(len(graph.edges))
    found[graph.edges.enabled] = np.einsum("mab,mba->m", problem.information, M) / 3.0
    return found


def ties(graph: KeyframeGraph) -> list[int]:
    """Rows of closures without which the graph falls apart: as many between sessions as tie them all."""
    nodes, edges = graph.nodes, graph.edges
    i, j, steps = nodes.rows(edges.i), nodes.rows(edges.j), ~edges.loop
    if len(np.unique(j[steps & edges.enabled & (edges.i < edges.j)])) == len(nodes) - 1:
        return []  # odometry comes to every keyframe but the first from an earlier one
    links = coo_matrix((np.ones(steps.sum()), (i[steps], j[steps])), shape=(len(nodes), len(nodes)))
    count, part = connected_components(links, directed=False)
    found: list[int] = []
    for row in np.flatnonzero(edges.loop & edges.enabled).tolist():
        if count == 1:
            break
        one, other = part[i[row]], part[j[row]]
        if one != other:
            part[part == other] = one
            found.append(row)
            count -= 1
    return found


def drop_least_needed(graph: KeyframeGraph, count: int, window: int) -> None:
    """Drop closures of least leverage, `count` at most, but for those of the last `window` keyframes.

    What they knew is lost: the graph becomes no surer. Those taken back go first.
    """
    edges = graph.edges
    old = edges.loop & (edges.j < graph.nodes.ids[-window])
    old[ties(graph)] = False
    leverage = np.where(old, leverages(graph), 1.0)
    least = np.argsort(leverage, kind="stable")[:count]
    kept = np.ones(len(edges), dtype=np.bool_)
    kept[least[leverage[least] < NEEDED]] = False
    edges.keep(kept)
