"""Which loops can be true: loops against the graph's poses, and against each other around the odometry.

Two questions, asked of one loop or of thousands at once:

- `innovations`: does a loop agree with the graph as it stands? With E = Z^-1 X_i^-1 X_j, e = Log(E), P the covariance
  of X_i^-1 X_j and Sigma that of the loop, d2 = e' (P + Sigma)^-1 e is chi2-distributed with d degrees of freedom if
  the loop is true. A new loop is tested against the accepted ones with one row.
- `pair_innovations`: do two loops agree with each other? Around the cycle loop a, odometry, loop b, odometry, the
  composed motion is the identity but for noise.

Passing such a test is worth something only if a wrong loop would have failed it. A wrong loop may lie anywhere in the
space of relative poses, of volume V (`space_log_volume`), so the evidence for a loop is the log of the ratio of
the two densities, log N(e; 0, S) + log V. The share of wrong loops that reach a given evidence is the volume of an
ellipsoid over V; `evidence_threshold` sets the level so that, over all loops tested, fewer than a given number of
wrong ones are to be expected. Tests too weak to tell (drift as large as the space) thus decide nothing.

Sources: pairwise consistency: Mangelson et al., "Pairwise consistent measurement set maximization for robust
multi-robot map merging" (ICRA 2018); innovation gates and the ratio of densities: Bar-Shalom, "Tracking and data
association" (1988); Latif et al., "Robust loop closing over time for pose graph SLAM" (RRR, IJRR 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import gammaln

from robominer_slam import geometry
from robominer_slam.geometry import FloatArray
from robominer_slam.slam import pose_graph_residuals as residuals

IndexArray = NDArray[np.int64]

#: Share of a loop's information that must be left over by the rest of the graph for a direction to be tested.
_LEAST_REDUNDANCY = 1e-2


@dataclass(frozen=True, slots=True)
class Loops:
    """Loops as arrays, m of them.

    Attributes:
        dim: 2 or 3.
        i, j: nodes, shape (m,).
        Z: T_i_j as measured, (m, 3) or (m, 4, 4); m and rad.
        covariance: of e = Log(Z^-1 X_i^-1 X_j), shape (m, d, d), translation first; m2, rad2.
    """

    dim: int
    i: IndexArray
    j: IndexArray
    Z: FloatArray
    covariance: FloatArray

    def __getitem__(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> Loops:
        """Some of the loops."""
        return Loops(self.dim, self.i[which], self.j[which], self.Z[which], self.covariance[which])


@dataclass(frozen=True, slots=True)
class Innovations:
    """Results of k consistency tests.

    Attributes:
        d: degrees of freedom, 3 in the plane, 6 in space.
        squared: d2, squared Mahalanobis distances, shape (k,).
        log_det: log det S of the covariances S they were taken with, shape (k,).
    """

    d: int
    squared: FloatArray
    log_det: FloatArray

    def __getitem__(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> Innovations:
        """Some of the tests."""
        return Innovations(self.d, self.squared[which], self.log_det[which])

    def with_covariance_times(self, factor: float) -> Innovations:
        """The same tests with all covariances multiplied."""
        return Innovations(self.d, self.squared / factor, self.log_det + self.d * np.log(factor))

    def evidence(self, log_volume: float) -> FloatArray:
        """log N(e; 0, S) + log V, shape (k,): how much better "true" explains each than "anywhere in V" (nat)."""
        return self.best_evidence(log_volume) - 0.5 * self.squared

    def best_evidence(self, log_volume: float) -> FloatArray:
        """The evidence each would have with d2 = 0, shape (k,)."""
        return log_volume - 0.5 * (self.d * np.log(2.0 * np.pi) + self.log_det)

    def chance(self, log_volume: float, gate: float, threshold: float = -np.inf) -> FloatArray:
        """Probability that a wrong loop, anywhere in V, has d2 < `gate` and evidence above `threshold`; shape (k,)."""
        r2 = np.clip(2.0 * (self.best_evidence(log_volume) - threshold), 0.0, gate)
        with np.errstate(divide="ignore"):
            log_ball = 0.5 * self.d * (np.log(np.pi) + np.log(r2)) - gammaln(0.5 * self.d + 1.0)
        return np.exp(np.minimum(log_ball + 0.5 * self.log_det - log_volume, 0.0))


def innovations(loops: Loops, poses: FloatArray, relative_covariance: FloatArray) -> Innovations:
    """Test loops against poses.

    Args:
        loops: m loops.
        poses: of all nodes, (n, 3) or (n, 4, 4).
        relative_covariance: P of X_i^-1 X_j as a twist in the frame of j, shape (m, d, d), from a graph without
            these loops (`PoseGraph.relative_covariances`).
    """
    e, P = _errors(loops, poses, relative_covariance)
    return _tested(e, P + loops.covariance)


def leave_one_out(loops: Loops, poses: FloatArray, relative_covariance: FloatArray) -> FloatArray:
    """d2 that each accepted loop would have against a graph without it, shape (m,), to first order.

    Args:
        loops: m loops that are part of the graph.
        poses: of all nodes, at the optimum, (n, 3) or (n, 4, 4).
        relative_covariance: P of X_i^-1 X_j, shape (m, d, d), from the graph with these loops. Sigma - P is the
            covariance of what is left of the error.
    """
    e, P = _errors(loops, poses, relative_covariance)
    root = np.linalg.cholesky(loops.covariance)
    whitened = np.linalg.solve(root, e[..., None])
    Q = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, P), -1, -2))
    share, axes = np.linalg.eigh(0.5 * (Q + np.swapaxes(Q, -1, -2)))
    # A direction that the loop alone determines (share 1) has no error to be tested by.
    remaining = np.maximum(1.0 - share, _LEAST_REDUNDANCY)
    return np.asarray(((np.swapaxes(axes, -1, -2) @ whitened)[..., 0] ** 2 / remaining).sum(axis=-1))


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
    Ad = _adjoint(dim, centred[1:])
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
    return pairs[np.maximum(low[a], low[b]) <= np.minimum(high[a], high[b])]


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
    tail = _compose(dim, b.Z, T_lj)
    E = _compose(dim, _inverse(dim, a.Z), _compose(dim, T_ik, tail))
    # All noises moved to the frame of j, at the end of the cycle.
    start = _moved(_adjoint(dim, _inverse(dim, _compose(dim, poses[b.i], tail))), _between(odometry, a.i, b.i))
    end = _moved(_adjoint(dim, _inverse(dim, poses[a.j])), _between(odometry, a.j, b.j))
    middle = _moved(_adjoint(dim, _inverse(dim, T_lj)), b.covariance)
    e = residuals.error_vectors(dim, E, "gtsam")
    slope = residuals.error_slopes(dim, E, e, "gtsam")
    return _tested(e, _moved(slope, start + end + middle) + a.covariance)


def clusters(pairs: IndexArray, count: int) -> IndexArray:
    """Number of the cluster of each of `count` loops, shape (count,): loops that `pairs` join share one."""
    joined = coo_matrix((np.ones(pairs.shape[0]), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def space_log_volume(dim: int, poses: FloatArray) -> float:
    """Log of the volume V of the relative poses a wrong loop may have (m^dim times the volume of the rotations).

    The side is twice the root mean square distance of the nodes from their mean: of the order of the bounding box,
    and also right for a trajectory that leaves a direction unused.
    """
    p = residuals.positions(dim, poses)
    side = 2.0 * np.sqrt(max(float(geometry.squared_norm(p - p.mean(axis=0)).mean()), np.finfo(float).tiny))
    return float(dim * np.log(side) + np.log(2.0 * np.pi if dim == 2 else 8.0 * np.pi**2))


def evidence_threshold(tests: Innovations, log_volume: float, gate: float, wrong: float) -> float:
    """Least evidence, 0 or more, at which `wrong` wrong loops are expected to pass, if all those tested were wrong."""
    low, high = 0.0, max(float(tests.best_evidence(log_volume).max(initial=0.0)), 0.0)
    if tests.chance(log_volume, gate, low).sum() <= wrong:
        return low
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        if tests.chance(log_volume, gate, middle).sum() <= wrong:
            high = middle
        else:
            low = middle
    return high


def convincing(tests: Innovations, log_volume: float, gate: float, wrong: float) -> NDArray[np.bool_]:
    """Which tests convince, shape (k,): d2 < `gate`, and at most `wrong` wrong loops are to be expected among them.

    A test convinces by its evidence (`evidence_threshold`), or by its strength alone: taken from the strongest on, as
    many tests as wrong loops would hardly pass need no more than the gate. That keeps true loops of a large but
    possible error.
    """
    passed = tests.squared < gate
    chance = tests.chance(log_volume, gate)
    order = np.argsort(chance, kind="stable")
    strong = np.empty(chance.size, dtype=np.bool_)
    strong[order] = np.cumsum(chance[order]) <= wrong
    by_evidence = tests.evidence(log_volume) > evidence_threshold(tests, log_volume, gate, wrong)
    return passed & (strong | by_evidence)


def _forward(loops: Loops) -> Loops:
    """The same loops, all with i < j."""
    back = loops.i > loops.j
    if not back.any():
        return loops
    inverse = _inverse(loops.dim, loops.Z)
    Z, covariance = loops.Z.copy(), loops.covariance.copy()
    Z[back] = inverse[back]
    # Z Exp(e) turned round is Exp(-e) Z^-1 = Z^-1 Exp(-Ad(Z) e).
    covariance[back] = _moved(_adjoint(loops.dim, loops.Z[back]), loops.covariance[back])
    return Loops(loops.dim, np.minimum(loops.i, loops.j), np.maximum(loops.i, loops.j), Z, covariance)


def _errors(loops: Loops, poses: FloatArray, relative_covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """e = Log(Z^-1 X_i^-1 X_j), shape (m, d), and the part of its covariance that the poses cause, (m, d, d)."""
    dim = loops.dim
    E = _compose(dim, _inverse(dim, loops.Z), residuals.relative_poses(dim, poses, loops.i, loops.j))
    e = residuals.error_vectors(dim, E, "gtsam")
    return e, _moved(residuals.error_slopes(dim, E, e, "gtsam"), relative_covariance)


def _tested(e: FloatArray, S: FloatArray) -> Innovations:
    S = 0.5 * (S + np.swapaxes(S, -1, -2))
    squared = np.einsum("ka,ka->k", e, np.linalg.solve(S, e[..., None])[..., 0])
    return Innovations(e.shape[-1], squared, np.linalg.slogdet(S)[1])


def _between(odometry: Odometry, i: IndexArray, j: IndexArray) -> FloatArray:
    return odometry.covariance[np.maximum(i, j)] - odometry.covariance[np.minimum(i, j)]


def _moved(M: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(M @ covariance @ np.swapaxes(M, -1, -2))


def _compose(dim: int, a: FloatArray, b: FloatArray) -> FloatArray:
    return geometry.se2_compose(a, b) if dim == 2 else np.asarray(a @ b)


def _inverse(dim: int, a: FloatArray) -> FloatArray:
    return geometry.se2_inverse(a) if dim == 2 else geometry.inverse(a)


def _adjoint(dim: int, a: FloatArray) -> FloatArray:
    return geometry.se2_adjoint(a) if dim == 2 else geometry.se3_adjoint(a)
