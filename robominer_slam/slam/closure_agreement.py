"""Whether closures say the same of the way between their keyframes: two that do are no chance.

Source: Mangelson et al., "Pairwise consistent measurement set maximization" (ICRA 2018).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robominer_slam import geometry
from robominer_slam.slam.closure_search import Closure
from robominer_slam.slam.keyframe_graph import KeyframeGraph


def agreeing(graph: KeyframeGraph, others: Sequence[Closure], closure: Closure, limit: float) -> list[Closure]:
    """Those of the others that agree with a closure: the squared Mahalanobis distance is `limit` at most."""
    if not others:
        return []
    a_i, a_j = np.array([a.i for a in others]), np.array([a.j for a in others])
    Z = np.stack([a.Z for a in others])
    # The closure predicted through another: its anchor -> the other's -> the other's keyframe -> its own.
    anchors, keyframes = graph.relatives(closure.i, a_i), graph.relatives(a_j, closure.j)
    way = geometry.se2_compose(geometry.se2_compose(anchors, Z), keyframes)
    error = geometry.se2_log(geometry.se2_compose(geometry.se2_inverse(way), closure.Z))
    Ad = geometry.se2_adjoint(geometry.se2_inverse(keyframes))
    covariance = Ad @ np.stack([a.covariance for a in others]) @ Ad.transpose(0, 2, 1) + closure.covariance
    for k, a in enumerate(others):
        covariance[k] += graph.odometry_between(a.j, closure.j)
        if a.i != closure.i:
            covariance[k] += graph.odometry_between(a.i, closure.i)
    squared = (error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).sum(axis=1)
    return [a for a, agrees in zip(others, squared <= limit, strict=True) if agrees]
