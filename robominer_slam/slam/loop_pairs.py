"""Which loops agree with each other, around the odometry between them.

Around the cycle loop a, odometry, loop b, odometry the composed motion is the identity but for noise. Two loops
between the same two stretches of the trajectory are thus compared by the few steps between their ends, however
far the odometry has drifted on the way from one stretch to the other: true loops of a revisit agree, wrong ones do
so by chance only, or where the same mistake was made all along.

Source: Mangelson, Dominic, Eustice and Vasudevan, "Pairwise consistent measurement set maximization for robust
multi-robot map merging" (ICRA 2018). In place of the largest clique, whose search is exponential, the connected
components of the pairs that agree; what does not belong in them is found out by the graph's optimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from robominer_slam.geometry import FloatArray
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.loop_consistency import IndexArray, Innovations, Loops, tested
from robominer_slam.slam.pose_algebra import adjoint, compose, inverse, moved


@dataclass(frozen=True, slots=True)
class Odometry:
    """Poses from odometry alone, and how their uncertainty grows.

    Attributes:
        poses: (n, 3) or (n, 4, 4), centred on their mean.
        covariance: of each node against the first, as a twist in the frame of the map (left perturbation), shape
            (n, d, d). The difference of two is the covariance of the motion between them.
    """

    poses: FloatArray
    covariance: FloatArray


def chain_odometry(dim: int, poses: FloatArray, step_covariance: FloatArray) -> Odometry:
    """Odometry along nodes 0, 1, 2, ...

    Args:
        dim: 2 or 3.
        poses: (n, 3) or (n, 4, 4), by odometry alone.
        step_covariance: of the step to node k + 1, as a twist in that node's frame, shape (n - 1, d, d).
    """
    centred = poses.copy()
    centre = residuals.positions(dim, poses).mean(axis=0)
    if dim == 2:
        centred[:, :2] -= centre
    else:
        centred[:, :3, 3] -= centre
    Ad = adjoint(dim, centred[1:])
    grown = np.zeros((poses.shape[0], *step_covariance.shape[1:]))
    np.cumsum(Ad @ step_covariance @ np.swapaxes(Ad, -1, -2), axis=0, out=grown[1:])
    return Odometry(centred, grown)


def neighbouring_pairs(loops: Loops, window: int) -> IndexArray:
    """Pairs (a, b) of loops whose ends lie at most `window` nodes apart along the trajectory, shape (k, 2).

    Left out are pairs whose two stretches of odometry overlap: the noise of the common part would count twice.
    """
    low, high = np.minimum(loops.i, loops.j), np.maximum(loops.i, loops.j)
    if low.size < 2:
        return np.empty((0, 2), dtype=np.int64)
    ends = np.stack([low, high], axis=-1).astype(np.float64)
    pairs = cKDTree(ends).query_pairs(float(window), p=np.inf, output_type="ndarray").astype(np.int64)
    a, b = pairs.T
    apart = np.maximum(low[a], low[b]) <= np.minimum(high[a], high[b])
    return np.asarray(pairs[apart], dtype=np.int64)


def pair_innovations(loops: Loops, odometry: Odometry, pairs: IndexArray) -> Innovations:
    """Test pairs of loops against each other: E = Z_a^-1 T_ik Z_b T_lj, with T from odometry.

    Args:
        loops: m loops.
        odometry: of the trajectory they belong to.
        pairs: (a, b), shape (k, 2).
    """
    dim, poses = loops.dim, odometry.poses
    forward = _forward(loops)
    a, b = forward[pairs[:, 0]], forward[pairs[:, 1]]
    T_ik = residuals.relative_poses(dim, poses, a.i, b.i)
    T_lj = residuals.relative_poses(dim, poses, b.j, a.j)
    tail = compose(dim, b.Z, T_lj)
    E = compose(dim, inverse(dim, a.Z), compose(dim, T_ik, tail))
    # All noises moved to the frame of j, at the end of the cycle.
    start = moved(adjoint(dim, inverse(dim, compose(dim, poses[b.i], tail))), _between(odometry, a.i, b.i))
    end = moved(adjoint(dim, inverse(dim, poses[a.j])), _between(odometry, a.j, b.j))
    middle = moved(adjoint(dim, inverse(dim, T_lj)), b.covariance)
    e = residuals.error_vectors(dim, E, "gtsam")
    slope = residuals.error_slopes(dim, E, e, "gtsam")
    return tested(e, moved(slope, start + end + middle) + a.covariance)


def clusters(pairs: IndexArray, count: int) -> IndexArray:
    """Number of the cluster of each of `count` loops, shape (count,): loops that `pairs` join share one."""
    joined = coo_matrix((np.ones(pairs.shape[0]), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def _forward(loops: Loops) -> Loops:
    """The same loops, all with i < j."""
    back = loops.i > loops.j
    if not back.any():
        return loops
    Z, covariance = loops.Z.copy(), loops.covariance.copy()
    Z[back] = inverse(loops.dim, loops.Z[back])
    # Z Exp(e) turned round is Exp(-e) Z^-1 = Z^-1 Exp(-Ad(Z) e).
    covariance[back] = moved(adjoint(loops.dim, loops.Z[back]), loops.covariance[back])
    return Loops(loops.dim, np.minimum(loops.i, loops.j), np.maximum(loops.i, loops.j), Z, covariance)


def _between(odometry: Odometry, i: IndexArray, j: IndexArray) -> FloatArray:
    return odometry.covariance[np.maximum(i, j)] - odometry.covariance[np.minimum(i, j)]
