"""Errors of a pose graph's edges and their Jacobians, for all edges at once.

An edge (i, j) with measurement Z = T_i_j has the error pose E = Z^-1 X_i^-1 X_j. Two conventions make it a vector:

- `gtsam`: e = Log(E), the full logarithm of SE(n), as GTSAM's BetweenFactor;
- `g2o`: e = (t, theta) of E in the plane, (t, vector part of the quaternion with w >= 0) in space, as EDGE_SE2
  and EDGE_SE3:QUAT. The rotation part in space is half an angle there.

Translation comes first in both, and so it does in the information matrices.

Poses are perturbed from the left, about a pivot c near the graph's middle: X <- C Exp(d) C^-1 X with C a pure
translation. Then E <- E Exp(Ad(X_j^-1 C) (d_j - d_i)): both Jacobians of an edge are equal but for the sign, the
normal equations are a graph Laplacian with matrix weights, and one symmetric block per edge fills all four of its
places. Gauss-Newton steps are the same as with the usual perturbation from the right; the pivot keeps lever
arms, and so the rounding, small when the map lies far from the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.geometry import FloatArray
from robominer_slam.slam import planar_residuals

Convention = Literal["gtsam", "g2o"]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class EdgeArrays:
    """The edges of a graph as arrays.

    Attributes:
        dim: 2 or 3.
        i, j: nodes, shape (m,).
        Z_inverse: inverse measurements, (m, 3) as (x, y, theta) in the plane, (m, 4, 4) in space; m and rad.
        information: Omega, shape (m, d, d), d = 3 or 6, translation first; 1/m2, 1/rad2 (g2o in space: of the
            quaternion's vector part).
    """

    dim: int
    i: IntArray
    j: IntArray
    Z_inverse: FloatArray
    information: FloatArray


def relative_poses(dim: int, poses: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    """X_i^-1 X_j, shape (m, 3) or (m, 4, 4)."""
    if dim == 2:
        return geometry.se2_compose(geometry.se2_inverse(poses[i]), poses[j])
    return np.asarray(geometry.inverse(poses)[i] @ poses[j])


def error_poses(edges: EdgeArrays, poses: FloatArray) -> FloatArray:
    """E = Z^-1 X_i^-1 X_j per edge, shape (m, 3) or (m, 4, 4)."""
    if edges.dim == 2:
        return planar_residuals.error_poses(poses, edges.i, edges.j, edges.Z_inverse)
    return np.asarray(edges.Z_inverse @ relative_poses(3, poses, edges.i, edges.j))


def error_vectors(dim: int, E: FloatArray, convention: Convention) -> FloatArray:
    """Error vectors (m, d) of the error poses `E`, translation first."""
    if dim == 2:
        return E if convention == "g2o" else planar_residuals.logarithms(E)
    if convention == "gtsam":
        return geometry.se3_log(E)
    return geometry.to_vector7(E)[..., :6]


def error_slopes(dim: int, E: FloatArray, e: FloatArray, convention: Convention) -> FloatArray:
    """Derivative (m, d, d) of the error by eta, where E <- E Exp(eta)."""
    if convention == "gtsam":
        if dim == 2:
            return geometry.se2_right_jacobian_inverse(e)
        return geometry.se3_right_jacobian_inverse(e, E[..., :3, 3])
    out = np.zeros((*e.shape, e.shape[-1]))
    if dim == 2:
        out[..., :2, :2] = geometry.rotation_2d(E[..., 2])
        out[..., 2, 2] = 1.0
        return out
    # q Exp(omega) = q (omega / 2, 1) to first order: the vector part gains (w omega + q_v x omega) / 2.
    q_vector = e[..., 3:]
    w = np.sqrt(np.maximum(0.0, 1.0 - geometry.squared_norm(q_vector)))
    out[..., :3, :3] = E[..., :3, :3]
    out[..., 3:, 3:] = 0.5 * (w[..., None, None] * np.eye(3) + geometry.hat(q_vector))
    return out


def world_to_node(dim: int, poses: FloatArray, pivot: FloatArray) -> FloatArray:
    """Ad(X^-1 C) per node, shape (n, d, d): from a perturbation about `pivot` to one in the node's own frame."""
    if dim == 2:
        x, y = poses[:, 0] - pivot[0], poses[:, 1] - pivot[1]
        Ad = np.zeros((len(poses), 3, 3))
        Ad[:, 0, 0] = Ad[:, 1, 1] = c = np.cos(poses[:, 2])
        Ad[:, 0, 1] = s = np.sin(poses[:, 2])
        Ad[:, 1, 0] = -s
        Ad[:, 0, 2] = s * x - c * y
        Ad[:, 1, 2] = c * x + s * y
        Ad[:, 2, 2] = 1.0
        return Ad
    centred = poses.copy()
    centred[:, :3, 3] -= pivot
    return geometry.se3_adjoint(geometry.inverse(centred))


def jacobians(
    dim: int, E: FloatArray, e: FloatArray, poses: FloatArray, j: IntArray, pivot: FloatArray, convention: Convention
) -> FloatArray:
    """Derivatives (m, d, d) of the edges' errors by the steps d_j about `pivot`; those by d_i are their negatives.

    Args:
        dim: 2 or 3.
        E, e: error poses and error vectors of the edges.
        poses: of all nodes.
        j: the edges' second nodes, shape (m,).
        pivot: shape (dim,), m.
        convention: of the error vectors.
    """
    if dim == 2:
        return planar_residuals.jacobians(E, poses[j], pivot, convention == "gtsam")
    return np.asarray(error_slopes(3, E, e, convention) @ world_to_node(3, poses, pivot)[j])


def pivot_of(dim: int, poses: FloatArray) -> FloatArray:
    """Middle of the nodes, shape (dim,), m: what steps are made about."""
    return np.asarray(np.add.reduce(positions(dim, poses)) / poses.shape[0])


def positions(dim: int, poses: FloatArray) -> FloatArray:
    """Positions of the nodes, shape (n, 2) or (n, 3), m."""
    return poses[:, :2] if dim == 2 else poses[:, :3, 3]


def perturbed(dim: int, poses: FloatArray, steps: FloatArray, pivot: FloatArray) -> FloatArray:
    """C Exp(d) C^-1 X per node: the poses after `steps` (n, d) about `pivot`."""
    if dim == 2:
        return planar_residuals.perturbed(poses, steps, pivot)
    moved = poses.copy()
    moved[:, :3, 3] -= pivot
    moved = geometry.se3_exp(steps) @ moved
    moved[:, :3, 3] += pivot
    return moved
