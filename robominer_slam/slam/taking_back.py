"""Optimises the graph, takes back the closures that its optimum contradicts, and lets return what it no longer does.

Source: Latif et al., "Robust loop closing over time" (IJRR 2013).
"""

from __future__ import annotations

import numpy as np

from robominer_slam.slam.closure_counters import ClosureCounters
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.level_edges import LevelEdges

#: Median of chi-square with three degrees of freedom: of closures whose covariances are right.
CHI2_MEDIAN = 2.366
#: Fewer closures do not tell whether their covariances are too wide.
LEAST_LIKES = 10
#: A closure within its own sigma contradicts nobody.
LEAST_LIMIT = 1.0
#: Times that closures are taken back or return before the graph is left as it is.
ROUNDS = 4


def limit(edges: LevelEdges, take_back: float) -> float:
    """Chi-square beyond which a closure is contradicted.

    Where the closures as a whole fit better than their covariances say, these are too wide, and one that stands
    out among its likes is wrong though its own covariance would allow for it: the limit shrinks with the median.

    Args:
        edges: of the optimised graph.
        take_back: the limit where covariances are right.
    """
    on = edges.loop & edges.enabled
    if int(on.sum()) < LEAST_LIKES:
        return take_back
    spread = float(np.median(edges.chi2[on])) / CHI2_MEDIAN
    return min(take_back, max(take_back * spread, LEAST_LIMIT))


def optimise(graph: KeyframeGraph, take_back: float, counters: ClosureCounters) -> None:
    """Optimise the whole graph, closures taken back and returned until that settles.

    Args:
        graph: its edges are switched.
        take_back: as of `limit`.
        counters: where it is counted.
    """
    edges = graph.edges
    for _ in range(ROUNDS):
        graph.optimise()
        contradicted = limit(edges, take_back)
        on = edges.loop & edges.enabled
        worst = float(edges.chi2[on].max(initial=0.0))
        if worst > contradicted:
            switched, back = on & (edges.chi2 > max(contradicted, 0.5 * worst)), False
        else:
            switched, back = edges.loop & ~edges.enabled & (edges.chi2 <= 0.5 * contradicted), True
        if not switched.any():
            return
        counters.counts["returned" if back else "taken_back"] += int(switched.sum())
        edges.switch(switched, back)
    graph.optimise()
