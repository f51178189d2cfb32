"""Planar graphs with slow biases: steps and gradients against finite differences, known biases, plain graphs."""

from __future__ import annotations

import numpy as np
import pytest

from robominer_slam import geometry as g
from robominer_slam.slam.linear_system import LinearSystem
from robominer_slam.slam.pose_graph import PoseGraph
from robominer_slam.slam.pose_graph_bias import BiasProblem, solve
from robominer_slam.slam.pose_graph_optimizer import Kernels, OptimizationOptions
from robominer_slam.slam.pose_graph_system import normal_system
from tests.pose_graph_problems import ring

BIAS = np.array([0.03, -0.02, 0.01])


def problem_of(graph: PoseGraph, jacobian, reference, prior, prior_information) -> BiasProblem:
    i, j = graph.edge_nodes.T
    return BiasProblem(
        i, j, graph.edge_measurements, graph.edge_information, jacobian, reference, prior, prior_information
    )


def biased_ring(seed: int = 0, noise: float = 0.01) -> tuple[BiasProblem, np.ndarray]:
    """Two rounds whose odometry was made with a wrong bias; poses as odometry has them."""
    graph = ring(noise=noise, seed=seed)
    odometry = np.array(graph.edge_nodes[:, 1] - graph.edge_nodes[:, 0] == 1)
    rng = np.random.default_rng(seed)
    turned = np.eye(3) + 0.2 * rng.normal(size=(graph.edge_count, 3, 3))
    jacobian = np.where(odometry[:, None, None], turned, 0.0)
    problem = problem_of(graph, jacobian, 0.3 * rng.normal(size=(graph.edge_count, 3)) * [0.01, 0.01, 0.01],
                         np.zeros(3), np.diag([400.0, 400.0, 900.0]))  # fmt: skip
    twist = (jacobian @ (problem.reference - BIAS)[:, :, None])[:, :, 0]
    Z = np.where(odometry[:, None], g.se2_compose(problem.Z, g.se2_exp(twist)), problem.Z * noise / 0.01)
    problem = BiasProblem(problem.i, problem.j, Z, problem.information, jacobian, problem.reference, problem.prior,
                          problem.prior_information)  # fmt: skip
    poses = [np.zeros(3)]
    for step in Z[odometry]:
        poses.append(g.se2_compose(poses[-1], step))
    return problem, np.array(poses)


def system_of(problem: BiasProblem, n: int) -> tuple[LinearSystem, Kernels]:
    m = len(problem.i)
    return (
        normal_system(problem.i, problem.j, np.arange(n) == 0, 3),
        Kernels(np.zeros(m, dtype=np.int8), np.ones(m)),
    )


def whitened(problem: BiasProblem, poses: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """All residuals with unit covariance, from the definition."""
    twist = np.einsum("mij,mj->mi", problem.jacobian, bias - problem.reference)
    Z = g.se2_compose(problem.Z, g.se2_exp(twist))
    relative = g.se2_compose(g.se2_inverse(poses[problem.i]), poses[problem.j])
    e = g.se2_log(g.se2_compose(g.se2_inverse(Z), relative))
    roots = np.linalg.cholesky(problem.information)
    prior = np.linalg.cholesky(problem.prior_information).T @ (bias - problem.prior)
    return np.concatenate([np.einsum("mji,mj->mi", roots, e).ravel(), prior])


def moved(poses: np.ndarray, bias: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All free poses moved in their own frames, and the bias."""
    twists = np.vstack([np.zeros(3), step[: 3 * (len(poses) - 1)].reshape(-1, 3)])
    return g.se2_compose(poses, g.se2_exp(twists)), bias + step[3 * (len(poses) - 1) :]


def numeric_jacobian(problem: BiasProblem, poses: np.ndarray, bias: np.ndarray) -> np.ndarray:
    size, h = 3 * (len(poses) - 1) + bias.size, 1e-6
    columns = []
    for e in h * np.eye(size):
        up, down = (whitened(problem, *moved(poses, bias, s)) for s in (e, -e))
        columns.append((up - down) / (2 * h))
    return np.column_stack(columns)


def test_a_step_is_the_gauss_newton_step_of_the_numeric_jacobian():
    # Near the minimum, where de/db = -B holds to first order in e.
    problem, poses = biased_ring(noise=1e-3)
    near = solve(problem, system_of(problem, len(poses))[1], poses, np.zeros(3), system_of(problem, len(poses))[0])
    rng = np.random.default_rng(1)
    start, bias = moved(near.poses, near.bias, 1e-4 * rng.normal(size=3 * len(poses)))
    J, r = numeric_jacobian(problem, start, bias), whitened(problem, start, bias)
    expected = moved(start, bias, -np.linalg.lstsq(J, r, rcond=None)[0])
    system, kernels = system_of(problem, len(poses))
    found = solve(problem, kernels, start, bias, system, max_iterations=1)
    assert found.iterations == 1
    for new, wanted, old in ((found.poses, expected[0], start), (found.bias, expected[1], bias)):
        assert np.abs(new - wanted).max() < 0.1 * np.abs(wanted - old).max()


def test_the_optimum_is_stationary():
    problem, poses = biased_ring(noise=1e-3)
    system, kernels = system_of(problem, len(poses))
    found = solve(problem, kernels, poses, np.zeros(3), system, max_iterations=30, tolerance=1e-14)
    J, r = numeric_jacobian(problem, found.poses, found.bias), whitened(problem, found.poses, found.bias)
    start = whitened(problem, poses, np.zeros(3))
    assert r @ r < 0.2 * (start @ start)
    # The bias's slope is good to first order in e, so the point is stationary to second.
    assert np.abs(np.linalg.lstsq(J, r, rcond=None)[0]).max() < 1e-4
    assert found.squared.sum() == pytest.approx((r[:-3] ** 2).sum(), rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_known_bias_is_recovered_from_loops(seed):
    problem, poses = biased_ring(seed)
    system, kernels = system_of(problem, len(poses))
    found = solve(problem, kernels, poses, np.zeros(3), system)
    J = numeric_jacobian(problem, found.poses, found.bias)
    covariance = np.linalg.inv(J.T @ J)[-3:, -3:]
    off = found.bias - BIAS
    assert off @ np.linalg.solve(covariance, off) < 16.3
    assert np.all(np.diag(covariance) < 0.5 / np.diag(problem.prior_information)), "the loops tell more than the prior"
    assert found.iterations <= 10


def test_without_loops_the_prior_alone_says_what_the_bias_is():
    problem, poses = biased_ring()
    chain = np.arange(len(poses) - 1)
    kept = np.flatnonzero(problem.j - problem.i == 1)[chain]
    problem = BiasProblem(problem.i[kept], problem.j[kept], problem.Z[kept], problem.information[kept],
                          problem.jacobian[kept], problem.reference[kept], np.array([0.01, 0.0, -0.01]),
                          problem.prior_information)  # fmt: skip
    system, kernels = system_of(problem, len(poses))
    found = solve(problem, kernels, poses, np.zeros(3), system)
    np.testing.assert_allclose(found.bias, problem.prior, atol=1e-9)


@pytest.mark.parametrize("nb", [0, 2])
def test_without_a_bias_it_equals_the_plain_pose_graph(nb):
    graph = ring(seed=3)
    m = graph.edge_count
    problem = problem_of(graph, np.zeros((m, 3, nb)), np.zeros((m, nb)), np.zeros(nb), np.eye(nb))
    system, kernels = system_of(problem, graph.node_count)
    found = solve(problem, kernels, graph.poses.copy(), np.zeros(nb), system, max_iterations=50, tolerance=1e-14)
    graph.optimize(OptimizationOptions(relative_tolerance=1e-14))
    np.testing.assert_allclose(found.poses, graph.poses, atol=1e-7)
    assert found.squared.sum() == pytest.approx(graph.chi2(), rel=1e-9)
