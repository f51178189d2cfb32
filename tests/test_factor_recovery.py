"""What keyframes that go leave behind: as much of what they knew as a sparse graph can say, and never more."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from robominer_slam import geometry
from robominer_slam.slam.closure_leverage import drop_least_needed, leverages
from robominer_slam.slam.factor_recovery import combined, recovered
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.keyframe_removal import remove_keyframes
from robominer_slam.slam.level_edges import LevelEdge
from tests.test_bounded_map import circling, loop, parts_at
from tests.test_bounded_sessions import two_sessions

#: Odometry's deviations per keyframe (m, m, rad), and those of closures.
STEP_SIGMA, CLOSURE_SIGMA = np.array([1e-3, 1e-3, 1e-3]), np.array([7e-3, 7e-3, 2e-2])


def straight(count: int, closures: list[tuple[int, int]], seed: int = 0) -> KeyframeGraph:
    """A robot that goes straight on, with closures between chosen keyframes, all with the noise that they claim."""
    rng = np.random.default_rng(seed)
    graph = KeyframeGraph()
    graph.bias = graph.bias_prior = np.full(3, 1e-4)
    graph.bias_prior_information = np.eye(3) * 1e7
    graph.nodes.append(0, np.zeros(3), 0.0, np.eye(3), 0.0)
    step = np.array([0.25, 0.0, 0.05])
    for k in range(1, count):
        Z = geometry.se2_exp(step + rng.normal(0.0, STEP_SIGMA))
        information = np.diag(STEP_SIGMA**-2)
        graph.edges.append(
            LevelEdge("odometry", k - 1, k, Z, information, 0.001, 1e5, -2.5 * np.eye(3), np.full(3, 1e-4))
        )
        graph.nodes.append(k, geometry.se2_compose(graph.nodes[k - 1], Z), 0.001 * k, np.eye(3), 0.25 * k)
    for i, j in closures:
        true = geometry.se2_exp(step * (j - i))
        Z = geometry.se2_compose(true, geometry.se2_exp(rng.normal(0.0, CLOSURE_SIGMA)))
        information = np.diag(CLOSURE_SIGMA**-2)
        dz = 0.001 * (j - i) + rng.normal(0.0, 0.003)
        graph.edges.append(LevelEdge("loop", i, j, Z, information, dz, 1e5, np.zeros((3, 3)), np.zeros(3)))
    graph.optimise()
    return graph


def between(graph: KeyframeGraph, p: int, q: int) -> np.ndarray:
    """Covariance of the pose of q in p, as a twist in q's frame."""
    Ad = geometry.se2_adjoint(geometry.se2_inverse(graph.relative(p, q)))
    A = np.concatenate([-Ad, np.eye(3)], axis=1)
    return A @ graph.covariance([p, q]) @ A.T


def alone(graph: KeyframeGraph, keys: list[int]) -> KeyframeGraph:
    """A graph of just the edges at some keyframes: what is marginalised when these go."""
    edges = graph.edges
    rows = np.flatnonzero(np.isin(edges.i, keys) | np.isin(edges.j, keys))
    local = KeyframeGraph()
    local.bias = local.bias_prior = graph.bias.copy()
    local.bias_prior_information = np.eye(3) * 1e16
    for k in np.unique(np.concatenate([edges.i[rows], edges.j[rows]])).tolist():
        local.nodes.append(k, graph.nodes[k], graph.nodes.height(k), np.eye(3), 0.25 * k)
    for row in rows.tolist():
        local.edges.append(edges.edge(row))
    return local


def test_edges_have_the_marginals_covariances_times_one_figure():
    graph = straight(14, [(0, 5), (0, 7), (1, 6), (3, 8)])
    keys = list(range(4, 12))
    marginal = alone(graph, keys)
    found = recovered(graph, keys)
    assert {(e.kind, e.i, e.j) for e in found} >= {("odometry", 3, 12)}
    figures = []
    for edge in found:
        share = np.linalg.inv(edge.information) @ np.linalg.inv(between(marginal, edge.i, edge.j))
        np.testing.assert_allclose(share, share[0, 0] * np.eye(3), atol=0.1 * share[0, 0])
        figures.append(share[0, 0])
    np.testing.assert_allclose(figures, figures[0], rtol=0.1)
    assert 1.0 < figures[0] < 2.5


@pytest.mark.parametrize("seed", range(3))
def test_the_tree_is_the_one_of_least_divergence(seed: int):
    """Of all trees that leave the odometry a chain, by the covariances of the dense marginal."""
    rng = np.random.default_rng(seed)
    ends = rng.choice(np.arange(0, 6), 4, replace=False)
    graph = straight(20, [(int(i), int(j)) for i, j in zip(ends, rng.integers(10, 14, 4), strict=True)], seed)
    keys = list(range(8, 16))
    marginal, edges = alone(graph, keys), recovered(graph, keys)
    around = sorted({e.i for e in edges} | {e.j for e in edges})
    assert len(edges) == len(around) - 1
    cost = {pair: float(np.linalg.slogdet(between(marginal, *pair))[1]) for pair in combinations(around, 2)}
    trees = [
        tree for tree in combinations(cost, len(around) - 1) if (7, 16) in tree and len(reached(tree)) == len(around)
    ]
    chosen = sum(cost[e.i, e.j] for e in edges)
    assert chosen == pytest.approx(min(sum(cost[pair] for pair in tree) for tree in trees), abs=0.05)


def reached(tree: tuple[tuple[int, int], ...]) -> set[int]:
    """Keyframes that pairs join to the first of them."""
    there, size = {tree[0][0]}, 0
    while len(there) > size:
        size = len(there)
        there |= {k for pair in tree if there & set(pair) for k in pair}
    return there


def test_edges_follow_the_biases_as_the_keyframes_did():
    """Pose, height and derivative: after the biases have changed, they are where the keyframes that went would be."""
    graph = straight(30, [(2, 10), (2, 12), (2, 14)])
    keys = list(range(8, 18))
    chain = next(edge for edge in recovered(graph, keys) if edge.kind == "odometry")
    marginal = alone(graph, keys)
    for bias in (graph.bias, graph.bias + np.array([2e-4, -1e-4, 3e-4])):
        marginal.bias = marginal.bias_prior = bias
        marginal.optimise()
        np.testing.assert_allclose(parts_at(chain, bias), marginal.relative(7, 18), atol=2e-5)
        assert chain.dz == pytest.approx(marginal.nodes.height(18) - marginal.nodes.height(7), abs=1e-6)
    step = parts_at(chain, graph.bias + 3e-4) - parts_at(chain, graph.bias)
    assert np.abs(step).max() > 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_many_removals_never_make_the_graph_surer_and_leave_it_stiff(seed: int):
    """Six rounds; of the last five only the ends stay: the first is still tied as its closures tied it."""
    graph = circling(64 * 6, seed, off=0.0)
    first = list(range(5, 60, 6))
    before = graph.covariance(first)
    odometry_alone = circling(64, seed).covariance(first)
    while len(graph.nodes) > 70:
        remove_keyframes(graph, graph.nodes.ids[64:-2][:16].tolist())
    assert (graph.edges.loop.sum()) < 120
    graph.optimise()
    after = graph.covariance(first)
    L = np.linalg.cholesky(before)
    ratios = np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, after).T))
    assert ratios[0] > 1.0
    assert np.trace(after) < 2.0 * np.trace(before) < 0.1 * np.trace(odometry_alone)


def test_closures_taken_back_are_not_recovered():
    graph = straight(20, [(1, 10), (2, 11)])
    graph.edges.switch(np.flatnonzero(graph.edges.loop), False)
    assert [(e.kind, e.i, e.j) for e in recovered(graph, [9, 10, 11, 12])] == [("odometry", 8, 13)]


def test_two_closures_between_the_same_keyframes_become_one():
    both, one = straight(20, [(1, 12)]), straight(20, [(1, 12)])
    second = loop(both, 1, 12, 0.004)
    both.edges.append(second)
    both.optimise()
    row = int(np.flatnonzero(one.edges.loop)[0])
    together = combined(one, one.edges.edge(row), second)
    one.edges.keep(~one.edges.loop)
    one.edges.append(together)
    one.optimise()
    np.testing.assert_allclose(one.nodes.poses, both.nodes.poses, atol=2e-5)
    np.testing.assert_allclose(one.covariance([12]), both.covariance([12]), rtol=1e-3, atol=1e-12)


def test_no_closure_becomes_surer_than_touches_are():
    graph = straight(20, [(1, 12)])
    many = graph.edges.edge(int(np.flatnonzero(graph.edges.loop)[0]))
    for _ in range(100):
        many = combined(graph, many, loop(graph, 1, 12, 0.0))
    assert np.linalg.eigvalsh(many.information)[-1] == pytest.approx(1e6)
    few = combined(graph, loop(graph, 1, 12, 0.0), loop(graph, 1, 12, 0.0))
    np.testing.assert_allclose(few.information, 2e5 * np.eye(3))


def test_a_recovered_closure_joins_the_one_that_is_there():
    graph = straight(30, [(2, 4), (2, 12), (4, 14)])
    remove_keyframes(graph, list(range(8, 25)))
    pairs = list(zip(graph.edges.i[graph.edges.loop].tolist(), graph.edges.j[graph.edges.loop].tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    assert (2, 4) in pairs


def test_closures_of_least_say_go_and_those_alone_stay():
    graph = straight(60, [(0, 30), (0, 31), (0, 32)])
    graph.edges.append(loop(graph, 10, 12, 0.0))
    weak = int(graph.edges.serial[-1])
    graph.edges.information[-1] *= 1e-4
    share = leverages(graph)
    assert share[-1] < 0.01
    chain = ~graph.edges.loop
    assert share[chain][40:] == pytest.approx(1.0, abs=0.3)
    before = graph.covariance([40])
    drop_least_needed(graph, 1, 5)
    assert weak not in graph.edges.serial
    assert graph.edges.loop.sum() == 3
    assert np.linalg.eigvalsh(graph.covariance([40]) - before)[0] >= -1e-3 * np.trace(before)


def test_closures_that_tie_sessions_are_never_let_go():
    graph = two_sessions(8)
    graph.edges.information[graph.edges.loop] *= 1e-2
    drop_least_needed(graph, 100, 5)
    assert 1 <= graph.edges.loop.sum() < 8
    graph.optimise()
    np.testing.assert_allclose(graph.relative(5, 45), [0.0, 0.2, 0.0], atol=1e-6)


def test_the_odometry_of_a_drive_without_end_never_becomes_too_loose_to_be_solved():
    """One edge bridges all keyframes that went; its uncertainty is bounded, and so is what numbers have to bear."""
    graph, first = straight(26, []), 12
    step, information = geometry.se2_exp(np.array([0.25, 0.0, 0.05])), np.diag(STEP_SIGMA**-2)
    for _ in range(60):
        remove_keyframes(graph, graph.nodes.ids[first:-2].tolist())
        for _ in range(first):
            k = int(graph.nodes.ids[-1]) + 1
            graph.edges.append(
                LevelEdge("odometry", k - 1, k, step, information, 0.0, 1e5, -2.5 * np.eye(3), graph.bias)
            )
            graph.nodes.append(k, geometry.se2_compose(graph.nodes[k - 1], step), 0.0, np.eye(3), 0.25 * k)
            graph.edges.append(loop(graph, k % (first - 1), k, 0.0))
    bridge = int(np.flatnonzero(~graph.edges.loop & (graph.edges.i == first - 1))[0])
    assert graph.edges.j[bridge] > 700
    assert graph.edges.dz_information[bridge] >= 1.0
    assert np.linalg.eigvalsh(graph.edges.covariance[bridge])[-1] <= 9.0
    graph.optimise()
    assert np.isfinite(graph.covariance([k])).all()


@pytest.mark.filterwarnings("ignore:invalid value")
def test_where_numbers_run_out_the_odometry_stays_a_chain_and_the_loss_is_counted():
    graph = straight(12, [(1, 9), (4, 8)])
    places = graph.nodes.poses.copy()
    # Edges of which no marginal can be had.
    graph.edges.information[graph.edges.loop] = np.nan
    remove_keyframes(graph, [4, 5])
    assert graph.loose_bridges == 1
    edges = graph.edges
    steps = sorted(zip(edges.i[~edges.loop].tolist(), edges.j[~edges.loop].tolist(), strict=True))
    assert steps == [(0, 1), (1, 2), (2, 3), (3, 6), (6, 7), (7, 8), (8, 9), (9, 10), (10, 11)]
    np.testing.assert_allclose(graph.nodes.poses, np.delete(places, [4, 5], axis=0))
