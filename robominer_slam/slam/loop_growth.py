"""The largest set of loops that agree with odometry and with each other, grown from the surest ones.

No robust kernel is safe alone: they start from all loops at once, and many wrong ones, or few in a floppy graph,
pull the start into the wrong valley; others reject true loops where drift is large against a loop's sigma. Here
the graph starts as odometry alone, and takes in only what it can judge at the time:

1. loops whose evidence is so strong that hardly one wrong loop would show it by chance (`loop_consistency`);
2. when there is none, the largest cluster of loops that agree with each other and pass the gate (`loop_pairs`);
3. when there is none, the level of 1 is relaxed, step by step, to the chosen number of wrong loops.

After each step the poses are optimised and every accepted loop is tested as if it had been left out: those that
disagree with the rest are taken back, the worst first. Each loop that is accepted makes the tests of the others
stronger. Only the last step decides loops that nothing else will ever touch.

Stated covariances are often far too large (the residuals of the public set M3500 are a sixth of its sigmas). The
noise is therefore measured on the accepted loops, and never taken as larger than stated: its median for the evidence,
its upper end for the gate, so that a few loops worse than the rest stay. The same factors apply to odometry, whose
drift the same errors contain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from robominer_slam.geometry import FloatArray
from robominer_slam.slam.loop_consistency import (
    IndexArray,
    Innovations,
    Loops,
    convincing,
    innovations,
    leave_one_out,
    space_log_volume,
    surely_placed,
    typical_squared,
)
from robominer_slam.slam.loop_pairs import clusters
from robominer_slam.slam.pose_graph import OptimizationOptions, PoseGraph

#: Expected number of wrong loops allowed, as shares of the chosen one: tried in turn.
_LADDER = (0.025, 1.0)
#: As many times more for loops whose place the graph knows: they can hardly bend it.
_FOR_SURELY_PLACED = 5.0
#: Odds for a loop, if one true loop were among all that are left: above e^0.4 = 1.5.
_LEAST_LOG_ODDS = 0.4
#: Random draws of the poses per step; variances are good to sqrt(2 / 64) = 18 %. What decides is tested exactly.
_DRAWS = 64
#: A loop that was taken back so often stays out.
_STRIKES = 3
_ROUNDS = 400
#: The noise is measured where this share of the errors lie below, on so many loops at least.
_UPPER_END, _LEAST_LOOPS = 0.99, 20
_GROWING = OptimizationOptions(relative_tolerance=1e-6)

BoolArray = NDArray[np.bool_]


class LoopGrowth:
    """Grows the accepted set on a graph of its own.

    Attributes:
        graph: odometry and loops; the accepted loops are enabled, the poses are the optimum with them.
        accepted: which loops, shape (m,).
        typical, noise: factors on all covariances, in (0, 1], from the median and the upper end of the errors.
        iterations, rounds: linear systems solved, steps taken.
    """

    def __init__(
        self, graph: PoseGraph, loop_edges: IndexArray, loops: Loops, agreeing: IndexArray, wrong: float, gate: float
    ) -> None:
        """Prepare.

        Args:
            graph: its poses are the odometry's.
            loop_edges: numbers of the loops' edges, shape (m,).
            loops: the same loops.
            agreeing: pairs of loops that agree, shape (k, 2).
            wrong: number of wrong loops to be expected at most.
            gate: limit of d2.
        """
        self.graph, self.loops = graph, loops
        self.accepted: BoolArray = np.zeros(loop_edges.size, dtype=np.bool_)
        self.typical = self.noise = 1.0
        self.iterations = self.rounds = 0
        self._edges, self._agreeing, self._wrong, self._gate = loop_edges, agreeing, wrong, gate
        self._ends = np.stack([loops.i, loops.j], axis=-1)
        self._own_log_det = np.linalg.slogdet(loops.covariance)[1]
        self._log_volume = space_log_volume(graph.dim, graph.poses)
        self._start = graph.poses
        self._strikes = np.zeros(loop_edges.size, dtype=np.int64)
        self._predicted = np.full(loop_edges.size, np.nan)

    def grow(self, first: BoolArray | None = None) -> None:
        """Grow from odometry, or from the loops `first`, shape (m,), until no loop is left that convinces."""
        self.graph.poses = self._start
        self.accepted = np.zeros_like(self.accepted) if first is None else first.copy()
        self._strikes[:], self._predicted[:] = 0, np.nan
        self.typical = self.noise = 1.0
        self._settle()
        level = 0
        for _ in range(_ROUNDS):
            candidates = np.flatnonzero(~self.accepted & (self._strikes < _STRIKES))
            tests = self._tests(candidates, exact=level == len(_LADDER) - 1)
            new = self._convincing(tests, candidates, _LADDER[level] * self._wrong)
            if not new.any():
                new = self._largest_cluster(candidates[tests.squared < self._gate * self.noise], candidates)
            if not new.any():
                level += 1
                if level == len(_LADDER):
                    return
                continue
            level = 0
            self.rounds += 1
            self._predicted[candidates[new]] = tests.squared[new]
            self.accepted[candidates[new]] = True
            self._settle()

    def _tests(self, candidates: IndexArray, exact: bool) -> Innovations:
        P = self._P[candidates]
        tests = innovations(self.loops[candidates], self.graph.poses, P)
        if exact:
            near = np.flatnonzero(tests.squared < 2.0 * self._gate * self.noise)
            P[near] = self.graph.relative_covariances(self._ends[candidates[near]])
            tests = innovations(self.loops[candidates], self.graph.poses, P)
        return tests

    def supported_but_rejected(self) -> list[BoolArray]:
        """Clusters of rejected loops that agree with each other, largest first; each a mask of shape (m,)."""
        out = np.flatnonzero(~self.accepted)
        label = self._clusters(out)
        sizes = np.bincount(label[out].astype(np.intp))
        return [label == k for k in np.argsort(-sizes, kind="stable") if sizes[k] >= 2]

    def _convincing(self, tests: Innovations, candidates: IndexArray, wrong: float) -> BoolArray:
        typical, upper = tests.with_covariance_times(self.typical), tests.with_covariance_times(self.noise)
        own = self._own_log_det[candidates] + tests.d * np.log(self.noise)
        placed = surely_placed(upper, own, self._log_volume, self._gate, _FOR_SURELY_PLACED * wrong)
        # One true loop among so many is the least to start from; the odds then have to speak for it.
        least = np.log(max(candidates.size, 1)) + _LEAST_LOG_ODDS
        return placed | convincing(typical, self._log_volume, self._gate * self.noise / self.typical, wrong, least)

    def _largest_cluster(self, passing: IndexArray, candidates: IndexArray) -> BoolArray:
        label = self._clusters(passing)
        sizes = np.bincount(label[passing].astype(np.intp), minlength=1)
        if sizes.max() < 2:
            return np.zeros(candidates.size, dtype=np.bool_)
        return np.asarray(label[candidates] == int(sizes.argmax()))

    def _clusters(self, among: IndexArray) -> IndexArray:
        """Cluster per loop, shape (m,); -1 for loops not in `among`."""
        chosen = np.zeros(self.accepted.size, dtype=np.bool_)
        chosen[among] = True
        label = clusters(self._agreeing[chosen[self._agreeing].all(axis=1)], chosen.size)
        return np.where(chosen, label, -1)

    def _settle(self) -> None:
        """Optimise, and take back loops that disagree with the rest until none does."""
        self._optimise()
        while self.accepted.any():
            inside = np.flatnonzero(self.accepted)
            d2 = leave_one_out(self.loops[inside], self.graph.poses, self._P[inside])
            self._measure_noise(d2)
            gate = self._gate * self.noise
            doubtful = inside[d2 > 0.5 * gate]
            if not doubtful.size:
                return
            P = self.graph.relative_covariances(self._ends[doubtful])
            d2 = leave_one_out(self.loops[doubtful], self.graph.poses, P)
            bad = doubtful[(d2 > gate) & (d2 > 0.7 * d2.max())]
            if not bad.size:
                return
            self.accepted[bad] = False
            self._strikes[bad] += 1
            self._optimise()

    def _optimise(self) -> None:
        self.graph.set_edge_enabled(self._edges, False)
        self.graph.set_edge_enabled(self._edges[self.accepted], True)
        self.iterations += self.graph.optimize(_GROWING).iterations
        self._P: FloatArray = self.graph.relative_covariances(self._ends, _DRAWS, seed=self.rounds)

    def _measure_noise(self, left_out: FloatArray) -> None:
        """Compare the errors with those stated, as they were predicted and as they are, whichever are larger."""
        predicted = self._predicted[self.accepted]
        predicted = predicted[np.isfinite(predicted)]
        self.typical = self.noise = 1.0
        if predicted.size >= _LEAST_LOOPS:
            d = 3 if self.graph.dim == 2 else 6
            typical = max(np.median(predicted), np.median(left_out)) / typical_squared(d)
            upper = max(np.quantile(predicted, _UPPER_END), np.quantile(left_out, _UPPER_END))
            self.typical = float(np.clip(typical, np.finfo(float).eps, 1.0))
            self.noise = float(np.clip(upper / chi2_distribution.ppf(_UPPER_END, d), self.typical, 1.0))
