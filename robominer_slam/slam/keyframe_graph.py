"""The graph of the method `robust`: keyframes level in map (x, y, heading), their heights, and the odometry's biases.

Gravity tells roll and pitch far better than touches do, so they are taken from the odometry; what is left are four
unknowns per keyframe. The plane's three are solved together with the slow biases (`pose_graph_bias`); heights are a
linear problem of their own.

A closure that says what the graph expects need not move all of it: `optimise_window` solves for the last keyframes
alone, held by those before them at their present poses.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from robominer_slam import geometry
from robominer_slam.slam import pose_graph_bias
from robominer_slam.slam.graph_marginals import GraphMarginals
from robominer_slam.slam.keyframe_nodes import KeyframeNodes
from robominer_slam.slam.level_edges import LevelEdge, LevelEdges
from robominer_slam.slam.linear_system import LinearSystem
from robominer_slam.slam.pose_graph_bias import BiasProblem
from robominer_slam.slam.pose_graph_optimizer import Kernels
from robominer_slam.slam.pose_graph_system import normal_system

__all__ = ["KeyframeGraph", "LevelEdge"]

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]


class KeyframeGraph:
    """Nodes and edges, and the biases that the odometry edges share.

    Attributes:
        nodes: keyframes by id.
        edges: all of them in the order of their making, those taken back too.
        bias: estimate of the slow biases, shape (nb,).
        bias_prior, bias_prior_information: what the odometry alone says of them.
        loose_bridges: how often what keyframes knew that went could not be computed, and was lost.
    """

    def __init__(self) -> None:
        self.nodes = KeyframeNodes()
        self.edges = LevelEdges()
        self.bias: FloatArray = np.zeros(0)
        self.bias_prior: FloatArray = np.zeros(0)
        self.bias_prior_information: FloatArray = np.zeros((0, 0))
        self.loose_bridges = 0
        self._system: tuple[tuple[int, int], LinearSystem] | None = None

    def optimise(self) -> None:
        """Move all keyframes and the biases to the least squared error; the first keyframe stays."""
        if len(self.nodes) < 2:
            return
        problem, system, kernels = self.problem()
        found = pose_graph_bias.solve(problem, kernels, self.nodes.poses.copy(), self.bias, system)
        self.nodes.poses[:] = found.poses
        self.bias = found.bias
        self._solve_heights(1)
        self.update_chi2()

    def optimise_window(self, count: int) -> None:
        """Move the last `count` keyframes to the least squared error; the others and the biases stay.

        Uncertainty of what is held does not enter: meant for closures that agree with the graph as it is.
        """
        first = max(1, len(self.nodes) - count)
        i, j, rows = self._ends(self.edges.enabled & (self.edges.j >= self.nodes.ids[first]))
        nodes, places = np.unique(np.concatenate([i, j]), return_inverse=True)
        i, j = places[: len(rows)], places[len(rows) :]
        edges = self.edges
        problem = BiasProblem(
            i.astype(np.int64),
            j.astype(np.int64),
            self.measured(rows),
            edges.information[rows],
            np.zeros((len(rows), 3, 0)),
            np.zeros((len(rows), 0)),
            np.zeros(0),
            np.zeros((0, 0)),
        )
        system = normal_system(problem.i, problem.j, nodes < first, 3)
        kernels = Kernels(np.zeros(len(rows), dtype=np.int8), np.ones(len(rows)))
        found = pose_graph_bias.solve(problem, kernels, self.nodes.poses[nodes], np.zeros(0), system)
        self.nodes.poses[nodes] = found.poses
        self._solve_heights(first)
        self.update_chi2()

    def update_chi2(self) -> None:
        """Squared errors of all edges at the present poses, those taken back included."""
        edges = self.edges
        if not len(edges):
            return
        poses = self.nodes.poses
        i, j, rows = self._ends(np.ones(len(edges), dtype=np.bool_))
        relative = geometry.se2_compose(geometry.se2_inverse(poses[i]), poses[j])
        error = geometry.se2_log(geometry.se2_compose(geometry.se2_inverse(self.measured(rows)), relative))
        edges.chi2[:] = np.einsum("mi,mij,mj->m", error, edges.information, error)

    def relative(self, i: int, j: int) -> FloatArray:
        """Pose (x, y, heading) of keyframe j in keyframe i, shape (3,)."""
        x_i, y_i, yaw_i = self.nodes[i].tolist()
        x_j, y_j, yaw_j = self.nodes[j].tolist()
        c, s, x, y = math.cos(yaw_i), math.sin(yaw_i), x_j - x_i, y_j - y_i
        return np.array([c * x + s * y, c * y - s * x, math.remainder(yaw_j - yaw_i, math.tau)])

    def relatives(self, i: ArrayLike, j: ArrayLike) -> FloatArray:
        """As `relative`, of many pairs at once, shape (m, 3); one of the two may be a single keyframe."""
        poses = self.nodes.poses
        return geometry.se2_compose(geometry.se2_inverse(poses[self.nodes.rows(i)]), poses[self.nodes.rows(j)])

    def marginals(self) -> GraphMarginals:
        """Covariances at the present poses, by one factorisation."""
        problem, system, kernels = self.problem()
        return GraphMarginals(problem, kernels, self.nodes.poses.copy(), self.bias, system)

    def covariance(self, nodes: list[int]) -> FloatArray:
        """Joint covariance of keyframes, shape (3 k, 3 k), each as a twist in its own frame."""
        return self.marginals().joint([self.nodes.row(k) for k in nodes])

    def odometry_between(self, a: int, b: int) -> FloatArray:
        """Covariance of the odometry between two keyframes, summed along the way; as of steps, arms left out."""
        if not len(self.edges):
            return np.zeros((3, 3))
        edges = self.edges
        steps = ~edges.loop & (edges.j > min(a, b)) & (edges.j <= max(a, b))
        return np.asarray(np.add.reduce(edges.covariance[steps], axis=0))

    def measured(self, rows: IndexArray) -> FloatArray:
        """Edges' Z at the present biases, shape (m, 3)."""
        edges = self.edges
        twist = (edges.jacobian[rows] @ (self.bias - edges.reference[rows])[:, :, None])[:, :, 0]
        return geometry.se2_compose(edges.Z[rows], geometry.se2_exp(twist))

    def _ends(self, chosen: NDArray[np.bool_]) -> tuple[IndexArray, IndexArray, IndexArray]:
        """Nodes' places that chosen edges join, and the edges' rows, shape (m,) each."""
        rows = np.flatnonzero(chosen)
        return self.nodes.rows(self.edges.i[rows]), self.nodes.rows(self.edges.j[rows]), rows

    def problem(self) -> tuple[BiasProblem, LinearSystem, Kernels]:
        """The edges that count as least squares over poses and biases, by places of nodes; all without kernels."""
        edges = self.edges
        i, j, rows = self._ends(edges.enabled)
        problem = BiasProblem(
            i.astype(np.int64),
            j.astype(np.int64),
            edges.Z[rows],
            edges.information[rows],
            edges.jacobian[rows],
            edges.reference[rows],
            self.bias_prior,
            self.bias_prior_information,
        )
        kernels = Kernels(np.zeros(len(rows), dtype=np.int8), np.ones(len(rows)))
        version = (self.nodes.version, edges.version)
        if self._system is None or self._system[0] != version:
            fixed = np.zeros(len(self.nodes), dtype=np.bool_)
            fixed[0] = True
            self._system = version, normal_system(problem.i, problem.j, fixed, 3)
        return problem, self._system[1], kernels

    def _solve_heights(self, first: int) -> None:
        """Heights of least squared error of the nodes from place `first` on; those before stay."""
        edges, z = self.edges, self.nodes.heights
        i, j, rows = self._ends(edges.enabled & (edges.j >= self.nodes.ids[first]))
        w, d = edges.dz_information[rows], edges.dz[rows]
        held, n = first, len(self.nodes)
        # About the first held height: small numbers lose no digits.
        datum = z[0]
        known = np.where(np.arange(n) < held, z - datum, 0.0)
        d = d - known[j] + known[i]
        a, b = i - held, j - held
        f = n - held
        both = (a >= 0) & (b >= 0)
        on_a, on_b = a >= 0, b >= 0
        rows_ = np.concatenate([a[on_a], b[on_b], a[both], b[both]])
        columns = np.concatenate([a[on_a], b[on_b], b[both], a[both]])
        values = np.concatenate([w[on_a], w[on_b], -w[both], -w[both]])
        L = csc_matrix((values, (rows_, columns)), shape=(f, f))
        right = np.bincount(b[on_b], (w * d)[on_b], f) - np.bincount(a[on_a], (w * d)[on_a], f)
        z[held:] = datum + splu(L, permc_spec="MMD_AT_PLUS_A").solve(right)
