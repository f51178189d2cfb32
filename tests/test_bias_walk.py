"""A bias that walks: edges follow the smoothed estimate of their own time, not today's bias."""

from __future__ import annotations

import numpy as np
import pytest

from robominer_slam import geometry
from robominer_slam.slam.bias_walk import FADED, BiasWalk, fade, faded_noise, smoothing_gain
from robominer_slam.slam.level_edges import LevelEdge, LevelEdges

WALK, NOISE, STEPS = 0.3, 1.0, 40


def edges_with(jacobians: np.ndarray, references: np.ndarray, slack: np.ndarray | None = None) -> LevelEdges:
    edges = LevelEdges()
    for k, (J, b) in enumerate(zip(jacobians, references, strict=True)):
        Z = np.array([0.2, 0.01 * k, 0.05])
        edges.append(LevelEdge("odometry", k, k + 1, Z, np.eye(3) * 100.0, 0.0, 1.0, J, b, slack=slack))
    return edges


def measured(edges: LevelEdges, bias: np.ndarray) -> np.ndarray:
    twist = (edges.jacobian @ (bias - edges.reference)[:, :, None])[:, :, 0]
    return geometry.se2_compose(edges.Z, geometry.se2_exp(twist))


def test_fading_keeps_what_the_edges_say_and_takes_from_what_they_will() -> None:
    rng = np.random.default_rng(0)
    edges = edges_with(rng.normal(0, 1, (5, 3, 2)), rng.normal(0, 0.01, (5, 2)))
    bias, later = np.array([0.02, -0.01]), np.array([1e-6, 2e-6])
    gain = np.array([[0.9, 0.02], [0.01, 0.8]])
    before, J = measured(edges, bias), edges.jacobian.copy()
    fade(edges, bias, gain)
    np.testing.assert_allclose(measured(edges, bias), before, atol=1e-12)
    moved = geometry.se2_log(geometry.se2_compose(geometry.se2_inverse(before), measured(edges, bias + later)))
    np.testing.assert_allclose(moved, (J @ gain @ later), atol=1e-10)


def test_edges_follow_the_smoothed_estimate() -> None:
    """Against the batch least squares of a scalar walk that is measured at every keyframe."""
    rng = np.random.default_rng(1)
    truth = np.cumsum(rng.normal(0, WALK, STEPS))
    z = truth + rng.normal(0, NOISE, STEPS)
    H = np.zeros((2 * STEPS - 1, STEPS))
    H[:STEPS] = np.eye(STEPS) / NOISE
    for k in range(STEPS - 1):
        H[STEPS + k, [k, k + 1]] = np.array([-1.0, 1.0]) / WALK
    right = np.concatenate([z / NOISE, np.zeros(STEPS - 1)])
    batch = np.linalg.lstsq(H, right, rcond=None)[0]
    # Forward filter, and edges whose heading is the bias itself.
    b, P = z[0], NOISE**2
    edges, walker = LevelEdges(), BiasWalk()
    J = np.array([[0.0], [0.0], [1.0]]) * 1e-3
    W = np.array([[WALK**2]])
    for k in range(STEPS):
        if k:
            walker.step(edges, np.array([b]), np.array([[P]]), W)
            predicted = P + WALK**2
            b = b + predicted / (predicted + NOISE**2) * (z[k] - b)
            P = predicted * NOISE**2 / (predicted + NOISE**2)
        edges.append(LevelEdge("odometry", k, k + 1, 1e-3 * np.array([0, 0, b]), np.eye(3), 0.0, 1.0, J, np.array([b])))
    found = measured(edges, np.array([b]))[:, 2] / 1e-3
    np.testing.assert_allclose(found, batch, atol=1e-6)
    assert np.abs(found - truth).mean() < np.abs(z - truth).mean()


def test_a_bias_that_stays_is_one_for_the_whole_drive() -> None:
    rng = np.random.default_rng(2)
    edges, walker = edges_with(rng.normal(0, 1, (5, 3, 2)), np.zeros((5, 2))), BiasWalk()
    J = edges.jacobian.copy()
    for walk in (None, np.zeros((2, 2))):
        walker.step(edges, np.array([1.0, 2.0]), np.eye(2), walk)
    np.testing.assert_array_equal(edges.jacobian, J)
    np.testing.assert_array_equal(smoothing_gain(np.eye(2), np.zeros((2, 2))), np.eye(2))
    assert not faded_noise(J[0], np.eye(2), np.zeros((2, 2))).any()


def test_a_faded_edge_gets_the_noise_of_its_bias_once() -> None:
    slack = np.diag([0.0, 0.0, 0.02])
    edges = edges_with(np.ones((1, 3, 1)), np.zeros((1, 1)), slack)
    fade(edges, np.zeros(1), np.array([[0.8]]))
    np.testing.assert_allclose(edges.covariance[0], np.eye(3) * 0.01)
    for _ in range(3):
        fade(edges, np.zeros(1), np.array([[0.8]]))
    assert edges.fade[0] < FADED
    np.testing.assert_allclose(edges.covariance[0], np.eye(3) * 0.01 + slack)
    np.testing.assert_allclose(edges.information[0] @ edges.covariance[0], np.eye(3), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_noise_of_faded_edges_sums_up_to_that_of_their_biases(seed: int) -> None:
    """Over many keyframes: the error of the smoothed biases' sum, which neighbours have in common."""
    rng, n, drives = np.random.default_rng(seed), 400, 300
    truth = np.cumsum(rng.normal(0, WALK, (drives, n)), axis=1)
    z = truth + rng.normal(0, NOISE, truth.shape)
    H = np.eye(n) / NOISE**2
    for k in range(n - 1):
        H[k : k + 2, k : k + 2] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / WALK**2
    error = np.linalg.solve(H, z.T / NOISE**2).T - truth
    middle = error[:, 50:-50].sum(axis=1)
    P = 0.5 * (-(WALK**2) + np.sqrt(WALK**4 + 4 * WALK**2 * NOISE**2))
    claimed = faded_noise(np.array([[0.0], [0.0], [1.0]]), np.array([[P]]), np.array([[WALK**2]]))[2, 2]
    assert middle.std() == pytest.approx(np.sqrt(claimed * (n - 100)), rel=0.15)
