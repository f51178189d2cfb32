"""The pose graph: keyframe poses as nodes, measured relative poses as edges, optimised over all of them.

Nodes and edges live in arrays that grow; everything that depends only on which nodes are joined is kept between
calls, so optimising after each keyframe of a growing graph costs one or two linear solves.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robominer_slam import geometry
from robominer_slam.geometry import FloatArray
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.growing_array import GrowingArray
from robominer_slam.slam.linear_system import LinearSystem, SingularSystemError
from robominer_slam.slam.pose_graph_covariance import (
    joint_covariance,
    relative_covariances,
    sampled_relative_covariances,
)
from robominer_slam.slam.pose_graph_edges import EdgeKind, PoseGraphEdges
from robominer_slam.slam.pose_graph_input import PoseGraphError, check_joined, checked_poses
from robominer_slam.slam.pose_graph_optimizer import OptimizationOptions, OptimizationResult, edge_costs, minimise
from robominer_slam.slam.pose_graph_residuals import Convention, EdgeArrays
from robominer_slam.slam.pose_graph_system import normal_system

__all__ = ["EdgeKind", "OptimizationOptions", "OptimizationResult", "PoseGraph", "PoseGraphError"]


class PoseGraph:
    """A pose graph in the plane (`dim` 2) or in space (3).

    Poses are (x, y, theta) in the plane, 4x4 matrices in space; m and rad. Information matrices are (3, 3) or
    (6, 6), translation first. The first node is fixed, unless `fix` names others.
    """

    def __init__(self, dim: Literal[2, 3]) -> None:
        """Start an empty graph.

        Raises:
            PoseGraphError: `dim` is neither 2 nor 3.
        """
        if dim not in (2, 3):
            raise PoseGraphError(f"dim is {dim}; expected 2 or 3")
        self.dim = dim
        self._d = 3 if dim == 2 else 6
        self._poses = GrowingArray((3,) if dim == 2 else (4, 4), np.float64)
        self._edges = PoseGraphEdges(dim)
        self._fixed: set[int] = {0}
        self._system: LinearSystem | None = None

    # ------------------------------------------------------------------------------------------------ data

    @property
    def node_count(self) -> int:
        """Number of nodes."""
        return len(self._poses)

    @property
    def edge_count(self) -> int:
        """Number of edges, disabled ones included."""
        return len(self._edges)

    @property
    def poses(self) -> FloatArray:
        """Copy of all poses, (n, 3) or (n, 4, 4)."""
        return np.array(self._poses.view)

    @poses.setter
    def poses(self, poses: ArrayLike) -> None:
        self._poses.view[...] = checked_poses(self.dim, poses, self.node_count, "pose")

    @property
    def edge_nodes(self) -> NDArray[np.int64]:
        """Nodes (i, j) of all edges, shape (m, 2)."""
        return np.stack([self._edges.i.view, self._edges.j.view], axis=-1)

    @property
    def edge_kinds(self) -> tuple[EdgeKind, ...]:
        """Kind of each edge."""
        return tuple(self._edges.kinds)

    @property
    def edge_enabled(self) -> NDArray[np.bool_]:
        """Whether each edge counts, shape (m,)."""
        return np.array(self._edges.enabled.view)

    @property
    def edge_measurements(self) -> FloatArray:
        """T_i_j of all edges, (m, 3) or (m, 4, 4)."""
        return self._edges.measurements

    @property
    def edge_information(self) -> FloatArray:
        """Omega of all edges, shape (m, d, d)."""
        return np.array(self._edges.information.view)

    @property
    def fixed_nodes(self) -> tuple[int, ...]:
        """Nodes that do not move, ascending."""
        return tuple(sorted(self._fixed))

    def add_node(self, pose: ArrayLike) -> int:
        """Add one node with a first guess of its pose, (3,) or (4, 4); returns its number, counted from 0."""
        return int(self.add_nodes(np.asarray(pose, dtype=np.float64)[None])[0])

    def add_nodes(self, poses: ArrayLike) -> NDArray[np.int64]:
        """Add k nodes, (k, 3) or (k, 4, 4); returns their numbers.

        Raises:
            PoseGraphError: a pose has a wrong shape, is not finite or holds no rotation.
        """
        checked = checked_poses(self.dim, poses, None, "node")
        first = self.node_count
        self._poses.extend(checked)
        self._system = None
        return np.arange(first, self.node_count)

    def add_edge(
        self,
        i: int,
        j: int,
        T_i_j: ArrayLike,
        information: ArrayLike,
        kind: EdgeKind = "odometry",
        kernel: str | None = None,
        kernel_width: float = 1.0,
    ) -> int:
        """Add one edge; returns its number, counted from 0. Arguments as in `add_edges`, without the first axis."""
        measurement, Omega = np.asarray(T_i_j, dtype=np.float64)[None], np.asarray(information, dtype=np.float64)[None]
        return int(self.add_edges([i], [j], measurement, Omega, kind, kernel, kernel_width)[0])

    def add_edges(
        self,
        i: ArrayLike,
        j: ArrayLike,
        T_i_j: ArrayLike,
        information: ArrayLike,
        kind: EdgeKind = "odometry",
        kernel: str | None = None,
        kernel_width: float = 1.0,
    ) -> NDArray[np.int64]:
        """Add k edges of one kind and kernel; returns their numbers.

        Args:
            i, j: nodes, shape (k,).
            T_i_j: measured poses of j in i, (k, 3) or (k, 4, 4).
            information: Omega, inverse covariance of the error, shape (k, d, d), translation first.
            kind: what the edges are from.
            kernel: robust kernel, see `robust_kernels`; None for least squares.
            kernel_width: of the kernel, in sigmas.

        Raises:
            PoseGraphError: a node does not exist, an edge joins a node with itself, a measurement is no pose, an
                information matrix is not symmetric and positive semidefinite, or the kernel is not known.
        """
        added = self._edges.add(self.node_count, i, j, T_i_j, information, kind, kernel, kernel_width)
        self._system = None
        return added

    def set_edge_enabled(self, edges: int | Sequence[int] | NDArray[np.int64], enabled: bool) -> None:
        """Take edges back (they stay listed but count for nothing), or let them count again."""
        self._edges.enabled.view[edges] = enabled
        self._system = None

    def set_edge_kernel(
        self, edges: int | Sequence[int] | NDArray[np.int64], kernel: str | None, kernel_width: float = 1.0
    ) -> None:
        """Give edges another robust kernel, see `robust_kernels`; None for least squares; the width is in sigmas.

        Raises:
            PoseGraphError: the kernel is not known, or its width is no number above 0.
        """
        self._edges.set_kernel(edges, kernel, kernel_width)

    def fix(self, nodes: Sequence[int]) -> None:
        """Fix these nodes, and no others, where they are (by default node 0).

        Raises:
            PoseGraphError: no node is given, or one does not exist.
        """
        chosen = {int(node) for node in nodes}
        if not chosen or min(chosen) < 0 or max(chosen) >= self.node_count:
            raise PoseGraphError(f"cannot fix nodes {sorted(chosen)}; expected some of the {self.node_count} nodes")
        self._fixed = chosen
        self._system = None

    # -------------------------------------------------------------------------------------------- optimising

    def edge_chi2(self, convention: Convention = "gtsam") -> FloatArray:
        """Squared errors e' Omega e of all edges, disabled ones too, at the present poses; no kernels; shape (m,)."""
        edges, kernels = self._edges.arrays(disabled_too=True)
        return edge_costs(edges, kernels, self._poses.view, convention).squared

    def chi2(self, convention: Convention = "gtsam") -> float:
        """Sum of e' Omega e over the enabled edges, without kernels."""
        return float(self.edge_chi2(convention)[self._edges.enabled.view].sum())

    def optimize(self, options: OptimizationOptions | None = None) -> OptimizationResult:
        """Move the nodes to the minimum of the cost near their present poses.

        Raises:
            PoseGraphError: there is no node, or a node is joined to no fixed one, or the information matrices
                leave a direction free.
        """
        options = options or OptimizationOptions()
        started = perf_counter()
        edges, kernels = self._edges.arrays()
        system = self._normal_system(edges)
        try:
            found = minimise(edges, kernels, self._poses.view, system, options)
        except SingularSystemError as error:
            raise PoseGraphError(
                f"the edges do not determine all poses ({error}); expected information of full rank"
            ) from error
        self._poses.view[...] = found.poses
        if self.dim == 3:
            # Products of many small rotations drift from orthogonality by rounding; never by more than that.
            free = system.free_nodes
            self._poses.view[free] = geometry.normalise_pose(found.poses[free])
        weights = np.zeros(self.edge_count)
        weights[self._edges.enabled.view] = found.after.weights
        return OptimizationResult(
            chi2_before=float(found.before.squared.sum()),
            chi2_after=float(found.after.squared.sum()),
            cost_before=found.before.cost,
            cost_after=found.after.cost,
            iterations=found.iterations,
            converged=found.converged,
            seconds=perf_counter() - started,
            weights=weights,
        )

    def joint_covariance(self, nodes: Sequence[int]) -> FloatArray:
        """Joint covariance of chosen nodes at the present poses, shape (k d, k d).

        Each node's part is of the twist eta (translation first) in X = X_present Exp(eta): in the node's own
        frame, m2 and rad2. Fixed nodes have none. Edges count with the weights of their kernels.

        Raises:
            PoseGraphError: as `optimize`.
        """
        edges, kernels = self._edges.arrays()
        try:
            return joint_covariance(edges, kernels, self._poses.view, self._normal_system(edges), nodes)
        except SingularSystemError as error:
            raise PoseGraphError(f"the edges do not determine all poses ({error})") from error

    def marginal_covariance(self, nodes: Sequence[int]) -> FloatArray:
        """Covariance of each chosen node on its own, shape (k, d, d); see `joint_covariance`."""
        joint = self.joint_covariance(nodes).reshape(len(nodes), self._d, len(nodes), self._d)
        return np.array(np.einsum("kakb->kab", joint))

    def relative_covariance(self, i: int, j: int) -> FloatArray:
        """Covariance (d, d) of X_i^-1 X_j, as a twist in the frame of j: what a loop (i, j) is compared with."""
        poses = self._poses.view
        T_j_i = residuals.relative_poses(self.dim, poses, np.array([j]), np.array([i]))[0]
        Ad = geometry.se2_adjoint(T_j_i) if self.dim == 2 else geometry.se3_adjoint(T_j_i)
        A = np.concatenate([-Ad, np.eye(self._d)], axis=1)
        return np.asarray(A @ self.joint_covariance([i, j]) @ A.T)

    def relative_covariances(self, pairs: ArrayLike, samples: int | None = None, seed: int = 0) -> FloatArray:
        """Covariances of X_i^-1 X_j for many pairs (i, j), shape (k, 2), as `relative_covariance`, shape (k, d, d).

        Args:
            pairs: nodes (i, j), shape (k, 2).
            samples: None for exact covariances, at d solutions a pair; else they come from so many random draws of
                all poses: a variance is off by sqrt(2 / samples) of itself, and pairs cost next to nothing.
            seed: of the draws.

        Raises:
            PoseGraphError: as `optimize`.
        """
        chosen = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        edges, kernels = self._edges.arrays()
        system = self._normal_system(edges)
        try:
            if samples is None:
                return relative_covariances(edges, kernels, self._poses.view, system, chosen)
            return sampled_relative_covariances(edges, kernels, self._poses.view, system, chosen, samples, seed)
        except SingularSystemError as error:
            raise PoseGraphError(f"the edges do not determine all poses ({error})") from error

    # ---------------------------------------------------------------------------------------------- internals

    def _normal_system(self, edges: EdgeArrays) -> LinearSystem:
        if self._system is None:
            if self.node_count == 0:
                raise PoseGraphError("the graph has no node; add the first pose before optimising")
            fixed = np.zeros(self.node_count, dtype=np.bool_)
            fixed[list(self._fixed)] = True
            check_joined(edges.i, edges.j, fixed)
            self._system = normal_system(edges.i, edges.j, fixed, self._d)
        return self._system
