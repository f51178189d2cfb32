"""Optimises a pose graph some of whose loops may be wrong: tells true from false, and optimises with the true ones.

1. Loops are compared with each other in pairs (`loop_pairs`), and a consistent set is grown from odometry
   (`loop_growth`).
2. If rejected loops agree among themselves, the growth is repeated from them: of sets that exclude each other the
   larger one is kept, whichever was met first.
3. The user's graph is optimised with the accepted loops; the others stay listed, disabled. The result has the
   largest error left, in sigmas.

There is one parameter, the number of wrong loops that may be expected to slip in; the gate is the chi2 quantile
that on average rejects as few true ones. What cannot be told, is not: a wrong loop that lies within the noise of
a true one is accepted, and a true loop that alone ties a far-drifted stretch to the map, is rejected.

Sources: consistency first: Mangelson et al. (PCM, ICRA 2018), Latif et al. (RRR, IJRR 2013); against robust kernels
alone: Agarwal et al. (DCS, ICRA 2013), Yang et al., "Graduated non-convexity for robust spatial perception" (RA-L
2020); error ratio after optimisation: Labbe and Michaud, "RTAB-Map as an open-source lidar and visual SLAM library"
(Journal of Field Robotics 2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2 as chi2_distribution

from robominer_slam import geometry
from robominer_slam.geometry import FloatArray
from robominer_slam.slam.loop_consistency import Loops, convincing, space_log_volume
from robominer_slam.slam.loop_growth import LoopGrowth
from robominer_slam.slam.loop_pairs import chain_odometry, neighbouring_pairs, pair_innovations
from robominer_slam.slam.pose_algebra import compose, inverse
from robominer_slam.slam.pose_graph import OptimizationOptions, OptimizationResult, PoseGraph, PoseGraphError
from robominer_slam.slam.pose_graph_residuals import Convention

#: Nodes between the ends of two loops that are compared; beyond, drift leaves little to compare.
_WINDOW = 20
#: How often rejected loops that agree among themselves may challenge the accepted ones.
_CHALLENGES = 3
#: A challenger may have as many times the noise at most.
_AS_QUIET = 2.0


@dataclass(frozen=True, slots=True)
class RobustResult:
    """What a robust optimisation did.

    Attributes:
        accepted: per edge, shape (m,); odometry always is; disabled edges are not.
        odometry: per edge: whether it was taken as odometry, shape (m,).
        noise: factor by which the errors of the accepted loops say the covariances are too large, in (0, 1].
        error_ratio: largest error left on an accepted edge, sqrt(e' Omega e / d), in stated sigmas.
        iterations: linear systems solved in all.
        rounds: steps of the growth.
        seconds: wall time.
        optimization: of the last optimisation, with the accepted edges: chi2, convergence, weights of the kernels
            (0 for rejected edges).
    """

    accepted: NDArray[np.bool_]
    odometry: NDArray[np.bool_]
    noise: float
    error_ratio: float
    iterations: int
    rounds: int
    seconds: float
    optimization: OptimizationResult


def optimize_robustly(
    graph: PoseGraph,
    options: OptimizationOptions | None = None,
    sequence: ArrayLike | None = None,
    wrong_loops: float = 0.1,
) -> RobustResult:
    """Optimise a graph with odometry that holds and loops that may be wrong; disable the wrong ones.

    Args:
        graph: edges between nodes that follow each other are odometry, all others loops. Disabled edges stay so;
            kernels count in the last optimisation only. The poses are a first guess of no importance.
        options: of the last optimisation.
        sequence: place of each node along the trajectory, 0 to n - 1, shape (n,); by default its number.
        wrong_loops: number of wrong loops that may be expected to be accepted, above 0.

    Raises:
        PoseGraphError: two nodes that follow each other have no odometry between them, an information matrix has
            no full rank, or as `PoseGraph.optimize`.
    """
    if not wrong_loops > 0.0:
        raise PoseGraphError(f"wrong_loops is {wrong_loops}; expected a number above 0")
    started = perf_counter()
    options = options or OptimizationOptions()
    place = np.arange(graph.node_count) if sequence is None else np.asarray(sequence, dtype=np.int64)
    if not np.array_equal(np.sort(place), np.arange(graph.node_count)):
        raise PoseGraphError(f"the sequence is no order of the {graph.node_count} nodes; expected each place once")
    ends, enabled = place[graph.edge_nodes], graph.edge_enabled
    odometry = np.abs(ends[:, 0] - ends[:, 1]) == 1
    work, numbers = _working_copy(graph, place, options.convention)
    accepted = enabled.copy()
    growth = _grown(work, ends[numbers], odometry[numbers], wrong_loops)
    if growth is not None:
        accepted[numbers[~odometry[numbers]]] = growth.accepted
    graph.poses = work.poses[place]
    graph.set_edge_enabled(np.flatnonzero(enabled & ~accepted), False)
    last = graph.optimize(options)
    left = graph.edge_chi2(options.convention)[accepted]
    return RobustResult(
        accepted=accepted,
        odometry=odometry,
        noise=1.0 if growth is None else growth.noise,
        error_ratio=float(np.sqrt(left.max(initial=0.0) / (3 if graph.dim == 2 else 6))),
        iterations=last.iterations + (0 if growth is None else growth.iterations),
        rounds=0 if growth is None else growth.rounds,
        seconds=perf_counter() - started,
        optimization=last,
    )


def _working_copy(
    graph: PoseGraph, place: NDArray[np.int64], convention: Convention
) -> tuple[PoseGraph, NDArray[np.int64]]:
    """The enabled edges without kernels, nodes in their sequence, and those edges' numbers in `graph`."""
    numbers = np.flatnonzero(graph.edge_enabled)
    information = graph.edge_information[numbers]
    if graph.dim == 3 and convention == "g2o":  # there the rotation's error is half an angle
        half = np.repeat([1.0, 0.5], 3)
        information = information * half[:, None] * half
    work = PoseGraph(2 if graph.dim == 2 else 3)
    poses = np.empty_like(graph.poses)
    poses[place] = graph.poses
    work.add_nodes(poses)
    i, j = place[graph.edge_nodes[numbers]].T
    work.add_edges(i, j, graph.edge_measurements[numbers], information)
    work.fix([int(place[node]) for node in graph.fixed_nodes])
    return work, numbers


def _grown(
    work: PoseGraph, ends: NDArray[np.int64], odometry: NDArray[np.bool_], wrong_loops: float
) -> LoopGrowth | None:
    loop_edges = np.flatnonzero(~odometry)
    if not loop_edges.size:
        return None
    information, d = work.edge_information, 3 if work.dim == 2 else 6
    steps = np.zeros((work.node_count - 1, d, d))
    np.add.at(steps, ends[odometry].min(axis=1), information[odometry])
    for k in np.flatnonzero(~steps.any(axis=(1, 2)))[:1]:
        raise PoseGraphError(
            f"no odometry between nodes {k} and {k + 1} of the sequence; expected an edge between all that follow "
            "each other, to judge the loops by"
        )
    try:
        step_covariance: FloatArray = np.asarray(np.linalg.inv(steps), dtype=np.float64)
        covariance: FloatArray = np.asarray(np.linalg.inv(information[loop_edges]), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise PoseGraphError("an information matrix is singular; expected full rank to judge loops by") from error
    work.set_edge_enabled(loop_edges, False)
    work.poses = _dead_reckoning(work, odometry)
    work.optimize()
    i, j = ends[loop_edges].T
    loops = Loops(work.dim, i, j, work.edge_measurements[loop_edges], covariance)
    gate = float(chi2_distribution.isf(min(wrong_loops, 0.5) / loop_edges.size, d))
    chain = chain_odometry(work.dim, work.poses, step_covariance)
    pairs = neighbouring_pairs(loops, _WINDOW)
    log_volume = space_log_volume(work.dim, work.poses)
    agreeing = pairs[convincing(pair_innovations(loops, chain, pairs), log_volume, gate, wrong_loops)]
    growth = LoopGrowth(work, loop_edges, loops, agreeing, wrong_loops, gate)
    growth.grow()
    _challenge(growth)
    return growth


def _challenge(growth: LoopGrowth) -> None:
    """Grow again from rejected loops that agree among themselves; keep the set with the most loops.

    A set that is larger only because it takes the noise for larger does not count.
    """
    for challenger in growth.supported_but_rejected()[:_CHALLENGES]:
        kept, poses, noise = growth.accepted, growth.graph.poses, growth.noise
        growth.grow(challenger)
        if growth.accepted.sum() <= kept.sum() or growth.noise > _AS_QUIET * noise:
            growth.accepted, growth.graph.poses, growth.noise = kept, poses, noise


def _dead_reckoning(work: PoseGraph, odometry: NDArray[np.bool_]) -> FloatArray:
    """Poses by one odometry edge per step, the first fixed node where it is."""
    dim, poses = work.dim, work.poses
    ends, Z = work.edge_nodes[odometry], work.edge_measurements[odometry]
    back = ends[:, 0] > ends[:, 1]
    Z[back] = inverse(dim, Z[back])
    steps = np.empty_like(poses[1:])
    steps[ends.min(axis=1)] = Z
    matrices = geometry.T_from_xyyaw(steps) if dim == 2 else steps
    chain = np.empty((poses.shape[0], 4, 4))
    chain[0] = np.eye(4)
    for k, step in enumerate(matrices):
        chain[k + 1] = chain[k] @ step
    out = geometry.xyyaw_of(chain) if dim == 2 else geometry.normalise_pose(chain)
    fixed = work.fixed_nodes[0]
    return compose(dim, compose(dim, poses[fixed], inverse(dim, out[fixed])), out)
