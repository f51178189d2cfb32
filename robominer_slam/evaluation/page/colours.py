"""Colours and line styles by method: Okabe and Ito's palette, told apart without colours by their dashes too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robominer_slam.evaluation.figures import ODOMETRY, TRUTH

#: The name under which dead reckoning stands beside the methods.
ODOMETRY_NAME = "odometry"
#: Black and orange are taken by truth and odometry.
METHODS = ("#0072B2", "#CC79A7", "#009E73", "#56B4E9", "#D55E00", "#F0E442")
DASHES = ("-", "-.", (0, (5, 1)), ":")
GRID = "#dddddd"


@dataclass(frozen=True, slots=True)
class Style:
    """How one series is drawn."""

    colour: str
    dashes: str | tuple[int, tuple[int, ...]]


def styles(series: Sequence[str]) -> dict[str, Style]:
    """The style of odometry and of every method and variant, the same on the whole page."""
    found = {ODOMETRY_NAME: Style(ODOMETRY, "--")}
    for k, name in enumerate(series):
        found[name] = Style(METHODS[k % len(METHODS)], DASHES[(k // len(METHODS)) % len(DASHES)])
    return found


__all__ = ["GRID", "METHODS", "ODOMETRY_NAME", "TRUTH", "Style", "styles"]
