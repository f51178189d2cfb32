"""The graph of the method `robust`: keyframes level in map (x, y, heading), their heights, and the odometry's biases.

Gravity tells roll and pitch far better than touches do, so they are taken from the odometry; what is left are four
unknowns per keyframe. The plane's three are solved together with the slow biases (`pose_graph_bias`); heights are a
linear problem of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from robominer_slam import geometry
from robominer_slam.slam import pose_graph_bias
from robominer_slam.slam.pose_graph_bias import BiasProblem
from robominer_slam.slam.pose_graph_optimizer import Kernels
from robominer_slam.slam.pose_graph_system import SystemPattern

FloatArray = NDArray[np.float64]


@dataclass
class LevelEdge:
    """A constraint between two keyframes, level.

    Attributes:
        kind: of odometry or of a loop closure.
        i, j: ids of the keyframes.
        Z: pose of j in i: x, y (m), heading (rad), shape (3,).
        information: of it, as a twist in j's frame, shape (3, 3).
        dz: height of j over i, m.
        dz_information: 1/m2.
        jacobian: what the slow biases do to Z, shape (3, nb).
        reference: the biases that Z was made with, shape (nb,).
        enabled: False where a closure was taken back.
        chi2: squared error at the last optimum.
    """

    kind: Literal["odometry", "loop"]
    i: int
    j: int
    Z: FloatArray
    information: FloatArray
    dz: float
    dz_information: float
    jacobian: FloatArray
    reference: FloatArray
    enabled: bool = True
    chi2: float = 0.0


@dataclass
class KeyframeGraph:
    """Nodes by id, edges in the order of their making.

    Attributes:
        poses: x, y, heading of each node in map, by id.
        heights: z of each node in map, by id, m.
        edges: all of them, those taken back too.
        bias: estimate of the slow biases, shape (nb,).
        bias_prior, bias_prior_information: what the odometry alone says of them.
    """

    poses: dict[int, FloatArray] = field(default_factory=dict)
    heights: dict[int, float] = field(default_factory=dict)
    edges: list[LevelEdge] = field(default_factory=list)
    bias: FloatArray = field(default_factory=lambda: np.zeros(0))
    bias_prior: FloatArray = field(default_factory=lambda: np.zeros(0))
    bias_prior_information: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def optimise(self) -> None:
        """Move all keyframes and the biases to the least squared error; the first keyframe stays."""
        if len(self.poses) < 2:
            return
        ids, problem, system, kernels = self._problem()
        start = np.array([self.poses[k] for k in ids])
        found = pose_graph_bias.solve(problem, kernels, start, self.bias, system)
        for k, pose in zip(ids, found.poses, strict=True):
            self.poses[k] = pose
        self.bias = found.bias
        self._optimise_heights(ids)
        self.update_chi2()

    def update_chi2(self) -> None:
        """Squared errors of all edges at the present poses, those taken back included."""
        if not self.edges:
            return
        i = np.array([self.poses[e.i] for e in self.edges])
        j = np.array([self.poses[e.j] for e in self.edges])
        twist = np.array([e.jacobian @ (self.bias - e.reference) for e in self.edges])
        Z = geometry.se2_compose(np.array([e.Z for e in self.edges]), geometry.se2_exp(twist))
        error = geometry.se2_log(
            geometry.se2_compose(geometry.se2_inverse(Z), geometry.se2_compose(geometry.se2_inverse(i), j))
        )
        Omega = np.array([e.information for e in self.edges])
        chi2 = np.einsum("mi,mij,mj->m", error, Omega, error)
        for edge, value in zip(self.edges, chi2, strict=True):
            edge.chi2 = float(value)

    def relative(self, i: int, j: int) -> FloatArray:
        """Pose (x, y, heading) of keyframe j in keyframe i, shape (3,)."""
        return geometry.se2_compose(geometry.se2_inverse(self.poses[i]), self.poses[j])

    def covariance(self, nodes: list[int]) -> FloatArray:
        """Joint covariance of keyframes, shape (3 k, 3 k), each as a twist in its own frame."""
        ids, problem, system, kernels = self._problem()
        place = {k: n for n, k in enumerate(ids)}
        poses = np.array([self.poses[k] for k in ids])
        return pose_graph_bias.joint_covariance(problem, kernels, poses, self.bias, system, [place[k] for k in nodes])

    def relative_covariance(self, i: int, j: int) -> FloatArray:
        """Covariance of `relative(i, j)` as a twist in the frame of j, shape (3, 3)."""
        Ad = geometry.se2_adjoint(geometry.se2_inverse(self.relative(i, j)))
        A = np.concatenate([-Ad, np.eye(3)], axis=1)
        return np.asarray(A @ self.covariance([i, j]) @ A.T)

    def _problem(self) -> tuple[list[int], BiasProblem, SystemPattern, Kernels]:
        ids = sorted(self.poses)
        place = {k: n for n, k in enumerate(ids)}
        edges = [e for e in self.edges if e.enabled]
        i = np.array([place[e.i] for e in edges], dtype=np.int64)
        j = np.array([place[e.j] for e in edges], dtype=np.int64)
        problem = BiasProblem(
            i,
            j,
            np.array([e.Z for e in edges]),
            np.array([e.information for e in edges]),
            np.array([e.jacobian for e in edges]),
            np.array([e.reference for e in edges]),
            self.bias_prior,
            self.bias_prior_information,
        )
        fixed = np.zeros(len(ids), dtype=np.bool_)
        fixed[0] = True
        kernels = Kernels(np.zeros(len(edges), dtype=np.int8), np.ones(len(edges)))
        return ids, problem, SystemPattern(i, j, fixed, 3), kernels

    def _optimise_heights(self, ids: list[int]) -> None:
        edges = [e for e in self.edges if e.enabled]
        place = {k: n for n, k in enumerate(ids)}
        i = np.array([place[e.i] for e in edges])
        j = np.array([place[e.j] for e in edges])
        w = np.array([e.dz_information for e in edges])
        d = np.array([e.dz for e in edges])
        n = len(ids)
        rows = np.concatenate([i, j, i, j])
        columns = np.concatenate([i, j, j, i])
        values = np.concatenate([w, w, -w, -w])
        L = csc_matrix((values, (rows, columns)), shape=(n, n))
        right = np.bincount(j, w * d, n) - np.bincount(i, w * d, n)
        z = np.zeros(n)
        z[1:] = splu(L[1:, 1:].tocsc(), permc_spec="MMD_AT_PLUS_A").solve(right[1:])
        first = self.heights[ids[0]]
        for k, height in zip(ids, z, strict=True):
            self.heights[k] = float(first + height)
