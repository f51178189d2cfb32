"""Least squares over planar poses and the slow biases of the odometry that joins them.

An odometry edge measures T_i_j = Z Exp(B (b - b0)), with b the biases that last the whole drive, B what they do to
this edge and b0 the values that Z was made with. With a prior on b, Gauss-Newton solves

    [ H_xx  H_xb ] [dx]     [g_x]
    [ H_bx  H_bb ] [db] = - [g_b],

where H_xx is the matrix of `linear_system` and the bias's few columns are eliminated first (a Schur
complement): one factorisation serves all of them. Errors e = Log(Z(b)^-1 X_i^-1 X_j); de/db = -B to first order in e.

Sources: Grisetti et al., "A tutorial on graph-based SLAM" (2010); Forster et al., "On-manifold preintegration" (T-RO
2017), section VI-C, for edges with a first-order bias correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.linear_system import Factors, LinearSystem
from robominer_slam.slam.pose_graph_optimizer import EdgeCosts, Kernels, edge_costs
from robominer_slam.slam.pose_graph_residuals import EdgeArrays

FloatArray = NDArray[np.float64]

_STEP_LENGTHS = tuple(0.5**k for k in range(10))


@dataclass(frozen=True, slots=True)
class BiasProblem:
    """A planar graph whose odometry has slow biases.

    Attributes:
        i, j: nodes of the edges, shape (m,).
        Z: measured poses of j in i, shape (m, 3): x, y (m), theta (rad).
        information: Omega, shape (m, 3, 3).
        jacobian: B of each edge, shape (m, 3, nb); zeros for loops.
        reference: b0 of each edge, shape (m, nb).
        prior: mean of b, shape (nb,).
        prior_information: of it, shape (nb, nb), positive definite.
    """

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    Z: FloatArray
    information: FloatArray
    jacobian: FloatArray
    reference: FloatArray
    prior: FloatArray
    prior_information: FloatArray

    def edges(self, bias: FloatArray) -> EdgeArrays:
        """The edges as they are for a bias, shape (nb,)."""
        twist = (self.jacobian @ (bias - self.reference)[:, :, None])[:, :, 0]
        Z = geometry.se2_compose(self.Z, geometry.se2_exp(twist))
        return EdgeArrays(2, self.i, self.j, geometry.se2_inverse(Z), self.information)


@dataclass(frozen=True, slots=True)
class BiasSolution:
    """What `solve` found.

    Attributes:
        poses: shape (n, 3).
        bias: shape (nb,).
        squared: e' Omega e per edge at the end, shape (m,).
        iterations: linear systems solved.
    """

    poses: FloatArray
    bias: FloatArray
    squared: FloatArray
    iterations: int


def solve(
    problem: BiasProblem,
    kernels: Kernels,
    poses: FloatArray,
    bias: FloatArray,
    system: LinearSystem,
    max_iterations: int = 10,
    tolerance: float = 1e-6,
) -> BiasSolution:
    """Poses and bias of least cost near those given.

    Args:
        problem: edges and prior.
        kernels: robust kernels of the edges.
        poses, bias: where to start, shapes (n, 3) and (nb,).
        system: normal equations of the same edges.
        max_iterations: linear systems solved at most.
        tolerance: stop when a step promises less than this share of the cost.

    Raises:
        SingularSystemError: the edges leave a direction free.
    """
    costs, cost = evaluate(problem, kernels, poses, bias)
    iterations = 0
    free = system.free_nodes
    while iterations < max_iterations:
        iterations += 1
        pivot = poses[:, :2].mean(axis=0)
        factors, step_x, step_b, promised, _, _ = linearised(problem, costs, poses, bias, pivot, system)
        del factors
        if promised <= tolerance * cost + 1e-12:
            break
        for length in _STEP_LENGTHS:
            candidate = poses.copy()
            candidate[free] = residuals.perturbed(2, poses[free], length * step_x, pivot)
            candidate_bias = bias + length * step_b
            new_costs, new_cost = evaluate(problem, kernels, candidate, candidate_bias)
            if new_cost < cost:
                break
        if not new_cost < cost:
            break
        gain = cost - new_cost
        poses, bias, costs, cost = candidate, candidate_bias, new_costs, new_cost
        if gain <= tolerance * cost:
            break
    return BiasSolution(poses, bias, costs.squared, iterations)


def evaluate(problem: BiasProblem, kernels: Kernels, poses: FloatArray, bias: FloatArray) -> tuple[EdgeCosts, float]:
    """Errors of all edges, and the cost with that of the bias's prior."""
    costs = edge_costs(problem.edges(bias), kernels, poses, "gtsam")
    off = bias - problem.prior
    return costs, costs.cost + float(off @ problem.prior_information @ off)


def linearised(
    problem: BiasProblem,
    costs: EdgeCosts,
    poses: FloatArray,
    bias: FloatArray,
    pivot: FloatArray,
    system: LinearSystem,
) -> tuple[Factors, FloatArray, FloatArray, float, FloatArray, FloatArray]:
    """Solve the normal equations once.

    Returns:
        Factors of H_xx, steps of poses (f, 3) and bias (nb,), promised gain, H_xx^-1 H_xb (3 f, nb), and the bias's
        information when the poses are eliminated (nb, nb).
    """
    J = residuals.jacobians(2, costs.E, costs.e, poses, problem.j, pivot, "gtsam")
    weighted = costs.weights[:, None, None] * problem.information
    J_Omega = J.transpose(0, 2, 1) @ weighted
    factors = system.factorise(J_Omega @ J)
    # The errors and the bias's columns together: what the edges have of H_xb and of the gradient sums up likewise.
    nb, m = bias.size, len(problem.i)
    columns = np.empty((m, 3, 1 + nb))
    columns[:, :, 0] = costs.e
    np.negative(problem.jacobian, out=columns[:, :, 1:])
    right = system.gradient((J_Omega @ columns).reshape(m, 3 * (1 + nb))).reshape(-1, 1 + nb)
    g_x, H_xb = right[:, 0], right[:, 1:]
    rows = columns.reshape(m * 3, 1 + nb)
    by_bias = rows[:, 1:].T @ (weighted @ columns).reshape(m * 3, 1 + nb)
    H_bb: FloatArray = by_bias[:, 1:] + problem.prior_information
    g_b: FloatArray = by_bias[:, 0] + problem.prior_information @ (bias - problem.prior)
    solved = np.asarray(factors.solve(right))
    y_g, y_b = solved[:, 0], solved[:, 1:]
    S = H_bb - H_xb.T @ y_b
    step_b = np.asarray(-np.linalg.solve(S, g_b - H_xb.T @ y_g), dtype=np.float64)
    step_x = -y_g - y_b @ step_b
    promised = -float(g_x @ step_x + g_b @ step_b)
    return factors, step_x.reshape(-1, 3), step_b, promised, y_b, S
