"""Covariances of keyframes from one factorisation, as many as are asked for, and of what is appended behind it.

With H_xx and H_xb of `pose_graph_bias` at the present poses, and S the bias's information without the poses,

    cov(x, x) = H_xx^-1 + Y S^-1 Y',   cov(x, b) = -Y S^-1,   cov(b, b) = S^-1,   Y = H_xx^-1 H_xb.

A keyframe n that only one odometry edge ties to the one before, m, has the error

    xi_n = Ad((Z Exp(B (b - b0)))^-1) xi_m + B db + eta,

so its covariances follow from those of (xi_m, b) without touching the graph. Closures made since the factorisation
are left out: what comes out is no smaller than the truth.

Source: Kaess and Dellaert, "Covariance recovery from a square root information matrix" (RAS 2009).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam import pose_graph_bias
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.linear_system import LinearSystem
from robominer_slam.slam.pose_graph_bias import BiasProblem
from robominer_slam.slam.pose_graph_optimizer import Kernels

if TYPE_CHECKING:
    from robominer_slam.slam.keyframe_graph import KeyframeGraph
    from robominer_slam.slam.level_edges import LevelEdge

FloatArray = NDArray[np.float64]


class GraphMarginals:
    """Covariances of a graph's nodes; holds the graph's factors: use and drop it in one thread.

    Args:
        problem, kernels, system: the graph.
        poses, bias: where it is linearised, shapes (n, 3) and (nb,).
    """

    def __init__(
        self,
        problem: BiasProblem,
        kernels: Kernels,
        poses: FloatArray,
        bias: FloatArray,
        system: LinearSystem,
    ) -> None:
        self._poses = poses
        self._pivot = poses[:, :2].mean(axis=0)
        costs, _ = pose_graph_bias.evaluate(problem, kernels, poses, bias)
        self._factors, _, _, _, self._by_bias, self._S = pose_graph_bias.linearised(
            problem, costs, poses, bias, self._pivot, system
        )
        self._f = system.free_nodes.size
        self._place = np.full(poses.shape[0], -1)
        self._place[system.free_nodes] = np.arange(self._f)

    def joint(self, nodes: list[int]) -> FloatArray:
        """Joint covariance of chosen nodes, shape (3 k, 3 k), each as a twist in its own frame; 0 for fixed nodes.

        The bias's uncertainty is in it.
        """
        columns = self._columns(nodes)
        covariance = columns.T @ self._factors.solve(columns)
        spread = columns.T @ self._by_bias
        covariance = covariance + spread @ np.linalg.solve(self._S, spread.T)
        return np.asarray(0.5 * (covariance + covariance.T))

    def joint_with_bias(self, nodes: list[int]) -> FloatArray:
        """As `joint`, the biases behind the nodes: shape (3 k + nb, 3 k + nb)."""
        k, nb = 3 * len(nodes), self._by_bias.shape[1]
        covariance = np.empty((k + nb, k + nb))
        of_bias = np.linalg.inv(self._S)
        covariance[:k, :k] = self.joint(nodes)
        covariance[:k, k:] = -(self._columns(nodes).T @ self._by_bias) @ of_bias
        covariance[k:, :k] = covariance[:k, k:].T
        covariance[k:, k:] = 0.5 * (of_bias + of_bias.T)
        return covariance

    def beside(self, node: int, other: int) -> tuple[FloatArray, FloatArray]:
        """Of `joint_with_bias` of two nodes what concerns the first, for half of the work.

        Returns:
            Its covariance, shape (3, 3), and that of it with the other and the biases, shape (3, 3 + nb).
        """
        columns, others = self._columns([node]), self._columns([other])
        solved, spread = np.asarray(self._factors.solve(columns)), columns.T @ self._by_bias
        by_bias = np.linalg.solve(self._S, spread.T).T
        own = columns.T @ solved + by_bias @ spread.T
        across = solved.T @ others + by_bias @ (others.T @ self._by_bias).T
        return 0.5 * (own + own.T), np.concatenate([across, -by_bias], axis=1)

    def _columns(self, nodes: list[int]) -> FloatArray:
        to_node = residuals.world_to_node(2, self._poses[nodes], self._pivot)
        selected = np.zeros((self._f, 3, len(nodes), 3))
        for column, node in enumerate(nodes):
            if self._place[node] >= 0:
                selected[self._place[node], :, column] = to_node[column].T
        return selected.reshape(self._f * 3, len(nodes) * 3)


class TrackedCovariance:
    """Covariance of the newest keyframe, and of it in earlier ones, at a bounded cost per keyframe.

    Args:
        graph: whose keyframes; its newest is followed.
        refresh: keyframes after which closures made since the factorisation are to count, too.
    """

    def __init__(self, graph: KeyframeGraph, refresh: int) -> None:
        self._graph = graph
        self._refresh = refresh
        self._base: GraphMarginals | None = None
        self._ids = np.zeros(0, dtype=np.int64)
        self._tail = 0
        self._closures = 0
        self._shrunk = False
        self._P = np.zeros((0, 0))
        self._way = np.zeros((0, 0))
        self._joined = np.zeros((0, 0))

    def forget(self) -> None:
        """Factorise anew when next asked: the graph says less than it did, or much more."""
        self._base = None

    @property
    def is_laborious(self) -> bool:
        """Whether a factorisation was made at this keyframe, or the next covariance asked for takes one."""
        return self._base is None or not self._tail

    def shrunk(self) -> None:
        """Keyframes have left the graph, and moved none of the others: it is factorised anew at the next keyframe."""
        self._shrunk = True

    def closed(self, closures: int, relative: FloatArray, sigma: float) -> None:
        """Closures were added to the graph; where they tell much, they count at once.

        Args:
            closures: how many.
            relative: covariance that the newest keyframe had in their anchors, the greatest, shape (3, 3).
            sigma: if it was less sure than this in x or y, m, they tell much.
        """
        self._closures += closures
        self._outdate()
        if self._base is not None and float(np.linalg.eigvalsh(relative[:2, :2])[-1]) > sigma**2:
            self.forget()

    def follow(self, edge: LevelEdge, bias: FloatArray, walk: FloatArray | None = None) -> None:
        """A keyframe was appended by an odometry edge.

        Args:
            edge: its edge.
            bias: the graph's, shape (nb,).
            walk: covariance of what the biases have changed by on the way, shape (nb, nb); None: nothing.
        """
        if self._base is None:
            return
        self._tail += 1
        self._outdate()
        if self._shrunk:
            self.forget()
        nb = bias.size
        step = geometry.se2_compose(edge.Z, geometry.se2_exp(edge.jacobian @ (bias - edge.reference)))
        F = np.eye(3 + nb)
        F[:3, :3] = geometry.se2_adjoint(geometry.se2_inverse(step))
        F[:3, 3:] = edge.jacobian
        if walk is not None:
            self._P[3:, 3:] += walk
        self._P = F @ self._P @ F.T
        self._P[:3, :3] += np.linalg.inv(edge.information)
        self._way = F @ self._way

    def of_newest(self) -> FloatArray:
        """Covariance of the newest keyframe as a twist in its own frame, shape (3, 3)."""
        self._prepare()
        covariance: FloatArray = self._P[:3, :3]
        return 0.5 * (covariance + covariance.T)

    def relative(self, anchor: int) -> FloatArray:
        """Covariance of the newest keyframe's pose in an earlier one, as a twist in the newest's frame, (3, 3)."""
        base = self._prepare()
        graph = self._graph
        newest = int(graph.nodes.ids[-1])
        row = int(np.searchsorted(self._ids, anchor))
        if row >= len(self._ids) or self._ids[row] != anchor:
            self.forget()
            base = self._prepare()
            row = int(np.searchsorted(self._ids, anchor))
        own, beside = base.beside(row, len(self._ids) - 1)
        across = beside @ self._way[:3].T
        joint = np.block([[own, across], [across.T, self._P[:3, :3]]])
        Ad = geometry.se2_adjoint(geometry.se2_inverse(graph.relative(anchor, newest)))
        A = np.concatenate([-Ad, np.eye(3)], axis=1)
        return np.asarray(A @ joint @ A.T)

    def _outdate(self) -> None:
        if self._closures and self._tail >= self._refresh:
            self.forget()

    def _prepare(self) -> GraphMarginals:
        if self._base is None:
            graph = self._graph
            base = graph.marginals()
            self._ids = graph.nodes.ids.copy()
            self._tail = self._closures = 0
            self._shrunk = False
            last = len(self._ids) - 1
            self._way = np.eye(3 + graph.bias.size)
            self._P = base.joint_with_bias([last])
            self._base = base
        return self._base
