"""Minimises a pose graph's cost: Gauss-Newton steps, shortened where they do not go down.

The cost is the sum over edges of rho(e' Omega e), rho being the edge's robust kernel; its slope weighs the edge in
the next linearisation (iteratively reweighted least squares). The matrix is positive definite, so its step always
points downhill, and some part of it goes down: halving a step costs an evaluation of the errors, where the damping
of Levenberg and Marquardt would cost a factorisation. Damping also holds back just the slow bending of a long
chain of poses that closing a loop needs: on the data set MIT it stalls where this takes twenty steps.

Sources: Grisetti et al., "A tutorial on graph-based SLAM" (2010); Nocedal and Wright, "Numerical optimization",
chapters 3.1 and 10.3; the kernels are in `robust_kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.geometry import FloatArray
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.linear_system import LinearSystem, solution
from robominer_slam.slam.pose_graph_residuals import Convention, EdgeArrays
from robominer_slam.slam.robust_kernels import robust_cost_and_weight

#: Lengths tried along a step, as shares of it.
_STEP_LENGTHS = tuple(0.5**k for k in range(12))
#: A step is taken if it gains at least this share of what its slope promises (Armijo's condition).
_LEAST_GAIN = 1e-4
#: Costs below this, per edge, are rounding: a graph whose edges agree exactly has nothing to minimise.
_ZERO_COST_PER_EDGE = 1e-18


@dataclass(frozen=True, slots=True)
class OptimizationOptions:
    """How to minimise.

    Attributes:
        convention: which error vectors, see `pose_graph_residuals`.
        max_iterations: linear systems solved at most; bounds the time.
        relative_tolerance: stop when what is left to gain is below this share of the cost.
    """

    convention: Convention = "gtsam"
    max_iterations: int = 100
    relative_tolerance: float = 1e-8

    def __post_init__(self) -> None:
        if self.convention not in ("gtsam", "g2o"):
            raise ValueError(f"convention {self.convention!r} is not known; expected 'gtsam' or 'g2o'")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations is {self.max_iterations}; expected 1 or more")
        if not 0.0 <= self.relative_tolerance < 1.0:
            raise ValueError(f"relative_tolerance is {self.relative_tolerance}; expected 0 <= tolerance < 1")


@dataclass(frozen=True, slots=True)
class EdgeCosts:
    """Errors of all edges at some poses.

    Attributes:
        E: error poses, (m, 3) or (m, 4, 4).
        e: error vectors, shape (m, d).
        squared: e' Omega e per edge, shape (m,).
        weights: of the robust kernels, shape (m,).
        cost: the sum that is minimised.
    """

    E: FloatArray
    e: FloatArray
    squared: FloatArray
    weights: FloatArray
    cost: float


@dataclass(frozen=True, slots=True)
class Kernels:
    """Robust kernel per edge: codes of `robust_kernels` and widths in sigmas, both of shape (m,)."""

    codes: NDArray[np.int8]
    widths: FloatArray


@dataclass(frozen=True, slots=True)
class Minimum:
    """What `minimise` found.

    Attributes:
        poses: (n, 3) or (n, 4, 4).
        before, after: errors at the first and at the last poses.
        iterations: linear systems solved.
        converged: False if `max_iterations` ended the search, or no part of a step made the cost go down.
    """

    poses: FloatArray
    before: EdgeCosts
    after: EdgeCosts
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True)
class OptimizationResult:
    """What one optimisation did.

    Attributes:
        chi2_before, chi2_after: sum of e' Omega e over the enabled edges, without kernels.
        cost_before, cost_after: the same through the kernels: what was minimised. Equal to chi2 without kernels.
        iterations: linear systems solved.
        converged: what is left to gain is below the tolerance.
        seconds: wall time.
        weights: of the kernels at the end, per edge in (0, 1]; 0 for a disabled edge; shape (m,).
    """

    chi2_before: float
    chi2_after: float
    cost_before: float
    cost_after: float
    iterations: int
    converged: bool
    seconds: float
    weights: FloatArray


def edge_costs(edges: EdgeArrays, kernels: Kernels, poses: FloatArray, convention: Convention) -> EdgeCosts:
    """Errors, weights and cost of all edges at `poses`."""
    E = residuals.error_poses(edges, poses)
    e = residuals.error_vectors(edges.dim, E, convention)
    squared = np.add.reduce((edges.information @ e[..., None])[..., 0] * e, axis=1)
    cost, weights = robust_cost_and_weight(squared, kernels.codes, kernels.widths)
    return EdgeCosts(E, e, squared, weights, float(np.add.reduce(cost)))


def normal_equations(
    edges: EdgeArrays,
    costs: EdgeCosts,
    poses: FloatArray,
    pivot: FloatArray,
    system: LinearSystem,
    convention: Convention,
) -> tuple[FloatArray, FloatArray]:
    """Gradient (f, d), and the edges' blocks J' Omega J (m, d, d) that make up H, for steps about `pivot`."""
    J = residuals.jacobians(edges.dim, costs.E, costs.e, poses, edges.j, pivot, convention)
    J_Omega = J.swapaxes(-1, -2) @ (costs.weights[:, None, None] * edges.information)
    gradient = system.gradient((J_Omega @ costs.e[..., None])[..., 0])
    return gradient, J_Omega @ J


def minimise(
    edges: EdgeArrays, kernels: Kernels, poses: FloatArray, system: LinearSystem, options: OptimizationOptions
) -> Minimum:
    """Poses of least cost near `poses`.

    Args:
        edges: the edges that count; `system` was built for them.
        kernels: their robust kernels.
        poses: where to start, (n, 3) or (n, 4, 4).
        system: their normal equations; nodes that it does not list as free keep their pose.
        options: convention and limits.

    Raises:
        SingularSystemError: the edges leave a direction free.
    """
    before = current = edge_costs(edges, kernels, poses, options.convention)
    negligible = _ZERO_COST_PER_EDGE * edges.i.size
    free = system.free_nodes
    iterations, converged, last_gain = 0, current.cost <= negligible, 0.0
    while not converged and iterations < options.max_iterations:
        iterations += 1
        pivot = residuals.pivot_of(edges.dim, poses)
        gradient, blocks = normal_equations(edges, current, poses, pivot, system, options.convention)
        steps = solution(system.factorise(blocks), -gradient)
        # By the linear model the whole step gains this, a part t of it (2 - t) t times this.
        promised = -float(np.vdot(gradient, steps))
        tolerance = options.relative_tolerance * current.cost + negligible
        start = poses.take(free, axis=0)
        for length in _STEP_LENGTHS:
            candidate = poses.copy()
            candidate[free] = residuals.perturbed(edges.dim, start, length * steps, pivot)
            costs = edge_costs(edges, kernels, candidate, options.convention)
            gain = current.cost - costs.cost
            if gain >= _LEAST_GAIN * length * promised or promised <= tolerance:
                break
        converged = promised <= tolerance
        if not gain >= 0.0:  # also where the errors at the candidate are no numbers
            break
        poses, current = candidate, costs
        if length == 1.0:
            # Whole steps gain less and less, at a linear rate or better: a geometric series bounds the rest, and
            # saves the factorisation that would only confirm it.
            converged = converged or 0.0 <= gain * gain <= tolerance * (last_gain - gain)
            last_gain = gain
        else:
            last_gain = 0.0
    return Minimum(poses, before, current, iterations, converged)
