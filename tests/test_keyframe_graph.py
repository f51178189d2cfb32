"""The graph of keyframes: covariances against a dense inverse, heights, biases, closures that were taken back."""

from __future__ import annotations

import numpy as np
import pytest

from robominer_slam import geometry as g
from robominer_slam.slam.graph_marginals import TrackedCovariance
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.level_edges import LevelEdge

STEP = np.array([0.25, 0.0, 0.3])
ODOMETRY = np.diag([1e4, 1e4, 4e4])
LOOP = np.diag([2e4, 1e4, 3e3])


def add_node(graph: KeyframeGraph, k: int, pose, height: float) -> None:
    graph.nodes.append(k, np.asarray(pose, dtype=float), height, np.eye(3), 0.25 * k)


def add_edge(graph: KeyframeGraph, kind: str, i: int, j: int, Z, dz: float = 0.0, jacobian=None, enabled: bool = True):
    J = np.zeros((3, 2)) if jacobian is None else jacobian
    information = ODOMETRY if kind == "odometry" else LOOP
    dz_information = 1e6 if kind == "odometry" else 1e5
    graph.edges.append(
        LevelEdge(kind, i, j, np.asarray(Z, dtype=float), information, dz, dz_information, J, np.zeros(2), enabled)
    )


def circle(bias=(0.0, 0.0), noise: float = 0.0, rise: float = 0.0) -> KeyframeGraph:
    """21 keyframes in a circle of that many steps, closed by a loop; the odometry has a bias of speed and turn."""
    rng = np.random.default_rng(0)
    graph = KeyframeGraph()
    graph.bias, graph.bias_prior = np.zeros(2), np.zeros(2)
    graph.bias_prior_information = np.diag([1e4, 1e4])
    J = -np.array([[1.0, 0.0], [0.0, 0.1], [0.0, 1.0]])
    pose = np.zeros(3)
    add_node(graph, 0, pose, 0.0)
    for k in range(1, 22):
        Z = g.se2_compose(g.se2_exp(STEP + noise * rng.normal(size=3)), g.se2_exp(-J @ np.array(bias)))
        pose = g.se2_compose(pose, Z)
        add_node(graph, k, pose, k * rise)
        add_edge(graph, "odometry", k - 1, k, Z, rise, J)
    return graph


def truth(i: int, j: int) -> np.ndarray:
    return g.se2_exp(STEP * (j - i))


def errors(graph: KeyframeGraph, moves: np.ndarray, n: int) -> np.ndarray:
    """Whitened residuals after moving all keyframes but the first in their own frames, and the bias."""
    twists = np.vstack([np.zeros(3), moves[:-2].reshape(-1, 3)])
    poses = [g.se2_compose(graph.nodes[k], g.se2_exp(twists[k])) for k in range(n)]
    bias = graph.bias + moves[-2:]
    parts = []
    for edge in (graph.edges.edge(row) for row in range(len(graph.edges))):
        Z = g.se2_compose(edge.Z, g.se2_exp(edge.jacobian @ (bias - edge.reference)))
        relative = g.se2_compose(g.se2_inverse(poses[edge.i]), poses[edge.j])
        parts.append(np.sqrt(np.diag(edge.information)) * g.se2_log(g.se2_compose(g.se2_inverse(Z), relative)))
    parts.append(np.sqrt(np.diag(graph.bias_prior_information)) * (bias - graph.bias_prior))
    return np.concatenate(parts)


def test_covariances_equal_those_of_the_dense_inverse():
    graph, n = circle(noise=1e-3), 22
    add_edge(graph, "loop", 1, 21, truth(1, 21))
    add_edge(graph, "loop", 3, 12, truth(3, 12))
    graph.optimise()
    size, h = 3 * (n - 1) + 2, 1e-6
    J = np.column_stack([(errors(graph, e, n) - errors(graph, -e, n)) / (2 * h) for e in h * np.eye(size)])
    dense = np.linalg.inv(J.T @ J)
    rows = [*range(3 * 8, 3 * 8 + 3), *range(3 * 20, 3 * 20 + 3)]
    joint = dense[np.ix_(rows, rows)]
    np.testing.assert_allclose(graph.covariance([9, 21]), joint, rtol=1e-3, atol=1e-8)
    np.testing.assert_allclose(graph.covariance([0, 9])[:3], 0.0, atol=1e-15)
    A = np.hstack([-g.se2_adjoint(g.se2_inverse(graph.relative(9, 21))), np.eye(3)])
    np.testing.assert_allclose(TrackedCovariance(graph, 1).relative(9), A @ joint @ A.T, rtol=1e-3, atol=1e-8)


def test_a_loop_moves_the_keyframes_and_teaches_the_bias():
    bias = np.array([0.008, -0.006])
    graph = circle(bias)
    off = np.abs(graph.relative(0, 21) - truth(0, 21)).max()
    add_edge(graph, "loop", 1, 21, truth(1, 21))
    add_edge(graph, "loop", 5, 16, truth(5, 16))
    graph.optimise()
    assert off > 0.1
    assert np.abs(graph.relative(1, 21) - truth(1, 21)).max() < 0.1 * off
    np.testing.assert_allclose(graph.bias, bias, atol=0.002)
    np.testing.assert_array_equal(graph.nodes[0], np.zeros(3))


def test_heights_share_out_what_a_loop_says():
    graph = circle(rise=0.01)
    graph.nodes.heights[0] = 5.0
    add_edge(graph, "loop", 1, 21, truth(1, 21), dz=0.0)
    graph.optimise()
    # Twenty steps of 1e6 in a row against one of 1e5: a third is the loop's.
    rise = 0.2 / (1.0 + 20 * 1e5 / 1e6)
    assert graph.nodes.height(21) - graph.nodes.height(1) == pytest.approx(rise, rel=1e-6)
    assert graph.nodes.height(1) == pytest.approx(5.01, abs=1e-9)
    assert graph.nodes.height(11) - graph.nodes.height(1) == pytest.approx(rise / 2, rel=1e-6)


def test_a_closure_taken_back_has_no_say_but_its_error_is_known():
    graph, without = circle(noise=1e-3), circle(noise=1e-3)
    add_edge(graph, "loop", 1, 21, truth(1, 21))
    add_edge(without, "loop", 1, 21, truth(1, 21))
    add_edge(graph, "loop", 3, 9, truth(3, 9) + np.array([0.5, 0.0, 0.0]), enabled=False)
    graph.optimise()
    without.optimise()
    for k in range(22):
        np.testing.assert_allclose(graph.nodes[k], without.nodes[k], atol=1e-12)
    chi2 = graph.edges.chi2
    assert chi2[-1] == pytest.approx(0.5**2 * 2e4, rel=0.9)
    assert chi2[-1] > 1000.0 * chi2[:-1].max()


def test_a_single_keyframe_has_nothing_to_optimise():
    graph = KeyframeGraph()
    add_node(graph, 0, [1.0, 2.0, 3.0], 0.5)
    graph.optimise()
    np.testing.assert_array_equal(graph.nodes[0], [1.0, 2.0, 3.0])
