"""Wrong loop closures for public pose graphs: scattered at random, or a group that agrees with itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.geometry import FloatArray
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.g2o_format import G2oGraph
from robominer_slam.slam.pose_algebra import compose, inverse
from robominer_slam.slam.pose_graph import OptimizationOptions, PoseGraph

GROUP_SIZE = 10


def pose_graph(content: G2oGraph) -> PoseGraph:
    """The graph of a file, all its edges alike."""
    graph = PoseGraph(content.dim)
    graph.add_nodes(content.poses)
    graph.add_edges(content.i, content.j, content.measurements, content.information)
    return graph


def optimum(content: G2oGraph) -> FloatArray:
    """Poses (n, 3) or (n, 4, 4) at the least-squares optimum with all edges."""
    graph = pose_graph(content)
    graph.optimize(OptimizationOptions(relative_tolerance=1e-12))
    return graph.poses


def is_loop(content: G2oGraph) -> NDArray[np.bool_]:
    """Edges between nodes whose numbers do not follow each other, shape (m,)."""
    return np.abs(content.ids[content.i] - content.ids[content.j]) != 1


def scattered(content: G2oGraph, poses: FloatArray, share: float, seed: int) -> tuple[G2oGraph, NDArray[np.bool_]]:
    """Wrong loops between random nodes, as a share of all loops: pose uniform in the graph's bounding box.

    Args:
        content: a graph without wrong loops.
        poses: its optimum, which gives the box.
        share: wrong / (wrong + true) loops.
        seed: of the random numbers.

    Returns:
        The graph with the wrong loops at the end, and which edges they are.
    """
    rng = np.random.default_rng(seed)
    count = round(int(is_loop(content).sum()) * share / (1.0 - share))
    pairs = rng.integers(0, content.ids.size, size=(4 * count + 10, 2))
    i, j = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 1][:count].T
    return _with_loops(content, i, j, _anywhere(rng, content.dim, poses, count))


def agreeing(content: G2oGraph, poses: FloatArray, seed: int) -> tuple[G2oGraph, NDArray[np.bool_]]:
    """Ten wrong loops that agree exactly: one stretch seen from another, after one rigid displacement to anywhere."""
    rng = np.random.default_rng(100 + seed)
    first, second = 0, 0
    while abs(first - second) < 2 * GROUP_SIZE:
        first, second = rng.integers(0, content.ids.size - GROUP_SIZE, size=2)
    i, j = first + np.arange(GROUP_SIZE), second + np.arange(GROUP_SIZE)
    middle = poses[second + GROUP_SIZE // 2]
    shift = compose(content.dim, _anywhere(rng, content.dim, poses, 1)[0], inverse(content.dim, middle))
    displaced = compose(content.dim, shift, poses[j])
    return _with_loops(content, i, j, compose(content.dim, inverse(content.dim, poses[i]), displaced))


def position_rmse(dim: int, poses: FloatArray, reference: FloatArray) -> float:
    """Root mean square distance of the positions, m, without alignment."""
    apart = residuals.positions(dim, poses) - residuals.positions(dim, reference)
    return float(np.sqrt(geometry.squared_norm(apart).mean()))


def _anywhere(rng: np.random.Generator, dim: int, poses: FloatArray, count: int) -> FloatArray:
    """Poses (count, 3) or (count, 4, 4) in the bounding box, every attitude alike."""
    p = residuals.positions(dim, poses)
    t = rng.uniform(p.min(axis=0), p.max(axis=0), size=(count, dim))
    if dim == 2:
        return np.column_stack([t, rng.uniform(-np.pi, np.pi, size=count)])
    return geometry.pose_matrix(t, rng.normal(size=(count, 4)))


def _with_loops(
    content: G2oGraph, i: NDArray[np.int64], j: NDArray[np.int64], Z: FloatArray
) -> tuple[G2oGraph, NDArray[np.bool_]]:
    information = np.median(content.information[is_loop(content)], axis=0)
    wrong = np.concatenate([np.zeros(content.i.size, dtype=np.bool_), np.ones(i.size, dtype=np.bool_)])
    more = replace(
        content,
        i=np.concatenate([content.i, i]),
        j=np.concatenate([content.j, j]),
        measurements=np.concatenate([content.measurements, Z]),
        information=np.concatenate([content.information, np.tile(information, (i.size, 1, 1))]),
    )
    return more, wrong
