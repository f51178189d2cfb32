"""How many closures were found, why they were refused, and what became of them."""

from __future__ import annotations

from collections import Counter

import numpy as np

from robominer_slam.configuration.robust_slam_section import ClosureSection
from robominer_slam.slam.closure_search import Closure


class ClosureCounters:
    """Counts.

    Attributes:
        counts: `found`, `accepted`, `taken_back`, `returned`, and `refused.<reason>`.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def found(self, closure: Closure, parameters: ClosureSection) -> None:
        """A search has found a place."""
        self.counts["found" if closure.good else f"refused.{refusal(closure, parameters)}"] += 1


def refusal(closure: Closure, parameters: ClosureSection) -> str:
    """The first check that a closure fails, in one word; `covariance` where none of the named does."""
    match, p = closure.match, parameters
    checks = (
        ("overlap", match.overlap >= p.min_overlap),
        ("inliers", match.inliers >= p.min_inliers),
        ("contrast", match.relief >= p.min_contrast * match.rms),
        ("uniqueness", closure.uniqueness >= p.uniqueness),
        ("moved", closure.moved <= p.max_moved),
        ("sigma", float(np.linalg.eigvalsh(closure.covariance[:2, :2])[-1]) <= p.max_sigma**2),
    )
    return next((name for name, fine in checks if not fine), "covariance")
