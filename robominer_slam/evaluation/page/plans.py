"""Pictures from above: paths (the thesis's figures 18 to 27), height maps, pose graphs, all runs of a drive (30)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from robominer_slam.evaluation.figures import graph_plan, height_plan, legend_above, plan_axes
from robominer_slam.evaluation.page.colours import ODOMETRY_NAME, TRUTH, Style
from robominer_slam.evaluation.page.pictures import WIDTH_IN
from robominer_slam.evaluation.page.run_view import RunView
from robominer_slam.evaluation.run_result import RunResult
from robominer_slam.mapping.height_grid import HeightGrid

FloatArray = NDArray[np.float64]

#: Room around what is shown: the array's reach, m.
MARGIN_M = 0.3
#: Paths that stray further than this from the truth are cut, or nothing else could be seen, m.
STRAY_M = 1.0
#: A straight drive still gets this much room across it, m.
MIN_SPAN_M = 1.2
#: Inches beside the axes: labels left, and colour bar right.
BESIDE_IN = 0.9
#: Inches above and below: legend of two lines, labels.
ABOVE_IN = 1.3
COLOUR_BAR_IN = 0.9


@dataclass(frozen=True, slots=True)
class Window:
    """What part of the map is shown: lower and upper corner, shape (2,), m."""

    low: FloatArray
    high: FloatArray

    def apply(self, axes: Axes) -> None:
        """Equal axes over this window."""
        plan_axes(axes, "box")
        axes.set_xlim(self.low[0], self.high[0])
        axes.set_ylim(self.low[1], self.high[1])

    def figure(self, extra_width: float = 0.0) -> tuple[Figure, Axes]:
        """A figure whose axes the window fills; `extra_width` in inches is left free beside them."""
        size = self.high - self.low
        width = WIDTH_IN - BESIDE_IN - extra_width
        height = float(np.clip(width * size[1] / size[0], 1.2, 7.0))
        figure = Figure(figsize=(WIDTH_IN, height + ABOVE_IN), layout="constrained")
        axes = figure.subplots()
        self.apply(axes)
        return figure, axes


def window_of(truth: FloatArray, others: Sequence[FloatArray]) -> Window:
    """Around the true path and what strays from it by less than a metre; paths of shape (n, 2), m."""
    everything = np.concatenate([truth, *others])
    low = np.maximum(everything.min(axis=0), truth.min(axis=0) - STRAY_M) - MARGIN_M
    high = np.minimum(everything.max(axis=0), truth.max(axis=0) + STRAY_M) + MARGIN_M
    missing = np.maximum(MIN_SPAN_M - (high - low), 0.0) / 2.0
    return Window(low - missing, high + missing)


def paths(runs: Sequence[RunView], odometry: RunView, styles: Mapping[str, Style], window: Window) -> Figure:
    """Truth, odometry and every method's path of one odometry noise."""
    figure, axes = window.figure()
    _truth(axes, odometry.truth)
    style = styles[ODOMETRY_NAME]
    axes.plot(*odometry.odometry.T, color=style.colour, linestyle=style.dashes, linewidth=1.4, label=ODOMETRY_NAME)
    for run in runs:
        style = styles[run.key.series]
        axes.plot(*run.slam.T, color=style.colour, linestyle=style.dashes, linewidth=1.1, label=run.key.series)
    _start(axes, odometry.truth)
    legend_above(axes)
    return figure


def heights(grid: HeightGrid, limits: tuple[float, float], window: Window) -> Figure:
    """The touched heights; `limits` of the colours, m."""
    figure, axes = window.figure(COLOUR_BAR_IN)
    height_plan(figure, axes, grid, limits)
    window.apply(axes)
    axes.grid(visible=False)
    return figure


def true_heights(result: RunResult, limits: tuple[float, float], window: Window) -> Figure | None:
    """The true surface around what was touched; None where nobody knows it."""
    if result.surface is None:
        return None
    return heights(replace(result.grid, height=result.surface), limits, window)


def pose_graph(result: RunResult, window: Window) -> Figure:
    """Keyframes and edges over the true path."""
    figure, axes = window.figure()
    graph_plan(axes, result.truth, result.graph, result.wrong)
    window.apply(axes)
    legend_above(axes)
    return figure


def all_paths(runs: Sequence[RunView], name: str, styles: Mapping[str, Style], window: Window) -> Figure:
    """The paths of all runs of one method, or of odometry, upon each other."""
    figure, axes = window.figure()
    _truth(axes, runs[0].truth)
    style = styles[name]
    for k, run in enumerate(runs):
        path = run.odometry if name == ODOMETRY_NAME else run.slam
        axes.plot(
            *path.T, color=style.colour, linewidth=0.9, alpha=0.6, label=f"{name}, {len(runs)} runs" if not k else None
        )
    _start(axes, runs[0].truth)
    legend_above(axes)
    return figure


def _truth(axes: Axes, truth: FloatArray) -> None:
    axes.plot(*truth.T, color=TRUTH, linewidth=2.4, label="ground truth")


def _start(axes: Axes, truth: FloatArray) -> None:
    axes.plot(*truth[0], "o", color=TRUTH, markersize=6, label="start")
