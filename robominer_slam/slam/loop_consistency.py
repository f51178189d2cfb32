"""Which loops can be true: one loop, or thousands at once, against the poses of a graph.

`innovations` asks whether a loop agrees with the graph as it stands. With E = Z^-1 X_i^-1 X_j, e = Log(E), P the
covariance of X_i^-1 X_j and Sigma that of the loop, d2 = e' (P + Sigma)^-1 e is chi2-distributed with d degrees of
freedom if the loop is true. A new loop is tested against the accepted ones with one row; an accepted one against
the rest of the graph by `leave_one_out`. Loops against each other are in `loop_pairs`.

Passing such a test is worth something only if a wrong loop would have failed it. A wrong loop may lie anywhere in the
space of relative poses, of volume V (`space_log_volume`), so the evidence for a loop is the log of the ratio of the
two densities, log p(e; S) + log V, with p Student's t. The share of wrong loops that reach a given evidence is the
volume of an ellipsoid over V; `evidence_threshold` sets the level so that, over all loops tested, fewer than a given
number of wrong ones are to be expected. Tests too weak to tell (drift as large as the space) thus decide nothing.

Sources: gates and the ratio of densities: Bar-Shalom and Fortmann, "Tracking and data association" (1988); chi2
tests of loops against the optimised graph: Latif, Cadena and Neira, "Robust loop closing over time for pose graph
SLAM" (RRR, IJRR 2013); `leave_one_out`: Baarda, "A testing procedure for use in geodetic networks" (1968).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from scipy.stats import f as f_distribution

from robominer_slam.geometry import FloatArray, squared_norm
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.pose_algebra import compose, inverse, moved

IndexArray = NDArray[np.int64]

#: Degrees of freedom of Student's t, the density of errors: real errors have heavier tails than a normal density.
_NU = 3.0
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
        """How much better "true" explains each than "anywhere in V": log p(e; S) + log V, nat, shape (k,)."""
        return self.best_evidence(log_volume) - 0.5 * (_NU + self.d) * np.log1p(self.squared / _NU)

    def best_evidence(self, log_volume: float) -> FloatArray:
        """The evidence each would have with d2 = 0, shape (k,)."""
        peak = gammaln(0.5 * (_NU + self.d)) - gammaln(0.5 * _NU) - 0.5 * self.d * np.log(_NU * np.pi)
        return np.asarray(log_volume + peak - 0.5 * self.log_det, dtype=np.float64)

    def chance(self, log_volume: float, gate: float, threshold: float = -np.inf) -> FloatArray:
        """Probability that a wrong loop, anywhere in V, has d2 < `gate` and evidence above `threshold`; shape (k,)."""
        exponent = np.minimum(2.0 / (_NU + self.d) * (self.best_evidence(log_volume) - threshold), 700.0)
        r2 = np.clip(_NU * np.expm1(exponent), 0.0, gate)
        with np.errstate(divide="ignore"):
            log_ball = 0.5 * self.d * (np.log(np.pi) + np.log(r2)) - gammaln(0.5 * self.d + 1.0)
        return np.asarray(np.exp(np.minimum(log_ball + 0.5 * self.log_det - log_volume, 0.0)), dtype=np.float64)


def innovations(loops: Loops, poses: FloatArray, relative_covariance: FloatArray) -> Innovations:
    """Test loops against poses.

    Args:
        loops: m loops.
        poses: of all nodes, (n, 3) or (n, 4, 4).
        relative_covariance: P of X_i^-1 X_j as a twist in the frame of j, shape (m, d, d), from a graph without
            these loops (`PoseGraph.relative_covariances`).
    """
    e, P = _errors(loops, poses, relative_covariance)
    return tested(e, P + loops.covariance)


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


def typical_squared(d: int) -> float:
    """Median of d2 if the covariances are right."""
    return d * float(f_distribution.median(d, _NU))


def space_log_volume(dim: int, poses: FloatArray) -> float:
    """Log of the volume V of the relative poses a wrong loop may have (m^dim times the volume of the rotations).

    The side is twice the root mean square distance of the nodes from their mean: of the order of the bounding box,
    and also right for a trajectory that leaves a direction unused.
    """
    p = residuals.positions(dim, poses)
    side = 2.0 * np.sqrt(max(float(squared_norm(p - p.mean(axis=0)).mean()), np.finfo(float).tiny))
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


def convincing(
    tests: Innovations, log_volume: float, gate: float, wrong: float, least: float = 0.0
) -> NDArray[np.bool_]:
    """Which loops convince by evidence, shape (k,): d2 < `gate`, and so good that `wrong` wrong ones at most pass.

    `least` is the least evidence asked for, whatever is to be expected.
    """
    threshold = max(evidence_threshold(tests, log_volume, gate, wrong), least)
    return np.asarray((tests.squared < gate) & (tests.evidence(log_volume) > threshold))


def surely_placed(
    tests: Innovations, own_log_det: FloatArray, log_volume: float, gate: float, wrong: float
) -> NDArray[np.bool_]:
    """Which loops convince by d2 < `gate` alone, shape (k,), because the graph knows where they belong.

    That needs a prediction at most twice as uncertain as the loop itself (sigma), and room for only `wrong` wrong
    loops to pass among those predicted as well or better. It keeps true loops of a large but possible error, which
    evidence cannot tell from luck.

    Args:
        tests: k tests.
        own_log_det: log det Sigma of the loops alone, shape (k,).
        log_volume, gate, wrong: as above.
    """
    chance = np.where(tests.log_det - own_log_det < tests.d * np.log(4.0), tests.chance(log_volume, gate), np.inf)
    order = np.argsort(chance, kind="stable")
    few = np.empty(chance.size, dtype=np.bool_)
    few[order] = np.cumsum(chance[order]) <= wrong
    return few & (tests.squared < gate)


def _errors(loops: Loops, poses: FloatArray, relative_covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors Log(Z^-1 X_i^-1 X_j), shape (m, d), and the part of its covariance that the poses cause, (m, d, d)."""
    dim = loops.dim
    E = compose(dim, inverse(dim, loops.Z), residuals.relative_poses(dim, poses, loops.i, loops.j))
    e = residuals.error_vectors(dim, E, "gtsam")
    return e, moved(residuals.error_slopes(dim, E, e, "gtsam"), relative_covariance)


def tested(e: FloatArray, S: FloatArray) -> Innovations:
    """Tests of errors (k, d) with covariances (k, d, d)."""
    S = 0.5 * (S + np.swapaxes(S, -1, -2))
    squared = np.einsum("ka,ka->k", e, np.linalg.solve(S, e[..., None])[..., 0])
    return Innovations(e.shape[-1], squared, np.linalg.slogdet(S)[1])
