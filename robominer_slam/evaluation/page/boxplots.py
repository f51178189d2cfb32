"""Boxplots of position errors: over all drives (the thesis's figure 16), and run by run (figure 29)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from robominer_slam.evaluation.page.colours import GRID, ODOMETRY_NAME, Style
from robominer_slam.evaluation.page.pictures import WIDTH_IN
from robominer_slam.evaluation.page.run_view import DriveViews

mpl.use("Agg")
FloatArray = NDArray[np.float64]

#: What the boxes are, for captions.
HOW_TO_READ = (
    "Box: middle half of all frames, with the median; whiskers: 5 % and 95 %; triangle: mean; dot: largest error"
)
HEIGHT_IN = 3.4
#: Room for a box, what stands beside all of them, and the widest figure, inches.
BOX_IN, BESIDE_IN, WIDEST_IN = 0.32, 1.0, 10.0
#: Share of a group's room that its boxes take.
FILLED = 0.8


def errors_by_drive(views: Sequence[DriveViews], series: Sequence[str], styles: Mapping[str, Style]) -> Figure:
    """Boxes of odometry and of every method side by side, drive by drive; views of one source."""
    groups = []
    for one in views:
        errors: dict[str, FloatArray] = {ODOMETRY_NAME: np.concatenate([run.odometry_error for run in one.odometry()])}
        for name in series:
            runs = one.of_series(name)
            if runs:
                errors[name] = np.concatenate([run.slam_error for run in runs])
        groups.append(errors)
    figure, axes = _figure(len(groups) * (1 + len(series)))
    _boxes(axes, groups, [ODOMETRY_NAME, *series], styles)
    labels = [one.drive.replace(", ", ",\n") for one in views]
    _finish(axes, labels, "", [ODOMETRY_NAME, *series], styles, cumulative=False)
    return figure


def errors_by_run(one: DriveViews, styles: Mapping[str, Style]) -> Figure:
    """Boxes for each odometry noise, and the mean over the runs up to each."""
    names = [ODOMETRY_NAME, *one.series]
    seeds = one.seeds
    of_series = {
        ODOMETRY_NAME: {run.key.odometry_seed: run.odometry_error for run in one.odometry()},
        **{name: {run.key.odometry_seed: run.slam_error for run in one.of_series(name)} for name in one.series},
    }
    groups = [{name: of_series[name][seed] for name in names if seed in of_series[name]} for seed in seeds]
    figure, axes = _figure(len(groups) * len(names))
    _boxes(axes, groups, names, styles)
    for name in names:
        means = [float(np.mean(group[name])) if name in group else np.nan for group in groups]
        known = np.isfinite(means)
        cumulative = np.cumsum(np.where(known, means, 0.0)) / np.maximum(np.cumsum(known), 1)
        style = styles[name]
        axes.plot(cumulative, color=style.colour, linestyle=style.dashes, linewidth=1.2, zorder=1)
    labels = ["-" if seed is None else str(seed) for seed in seeds]
    _finish(axes, labels, "run: seed of the odometry's noise", names, styles, cumulative=True)
    return figure


def _figure(boxes: int) -> tuple[Figure, Axes]:
    width = float(np.clip(BESIDE_IN + BOX_IN * boxes, WIDTH_IN, WIDEST_IN))
    figure = Figure(figsize=(width, HEIGHT_IN), layout="constrained")
    return figure, figure.subplots()


def _boxes(
    axes: Axes, groups: Sequence[Mapping[str, FloatArray]], names: Sequence[str], styles: Mapping[str, Style]
) -> None:
    step = FILLED / len(names)
    for k, name in enumerate(names):
        shift = (k - (len(names) - 1) / 2.0) * step
        present = [i for i, group in enumerate(groups) if name in group]
        statistics = [_statistics(groups[i][name]) for i in present]
        if not statistics:
            continue
        places = [i + shift for i in present]
        axes.bxp(
            statistics,
            positions=places,
            widths=0.8 * step,
            showfliers=False,
            showmeans=True,
            patch_artist=True,
            boxprops={"facecolor": styles[name].colour, "edgecolor": "black", "linewidth": 0.7},
            medianprops={"color": "black", "linewidth": 1.4},
            whiskerprops={"color": "black", "linewidth": 0.7},
            capprops={"color": "black", "linewidth": 0.7},
            meanprops={"marker": "^", "markersize": 4.5, "markerfacecolor": "white", "markeredgecolor": "black"},
        )
        largest = [groups[i][name].max() for i in present]
        axes.plot(places, largest, "o", color=styles[name].colour, markersize=3.0, markeredgecolor="black",
                  markeredgewidth=0.4)  # fmt: skip


def _statistics(errors: FloatArray) -> dict[str, Any]:
    low, q1, median, q3, high = (float(v) for v in np.percentile(errors, (5, 25, 50, 75, 95)))
    return {"med": median, "q1": q1, "q3": q3, "whislo": low, "whishi": high, "mean": float(np.mean(errors))}


def _finish(
    axes: Axes,
    labels: Sequence[str],
    xlabel: str,
    names: Sequence[str],
    styles: Mapping[str, Style],
    *,
    cumulative: bool,
) -> None:
    axes.set_xticks(range(len(labels)), labels)
    axes.set_xlim(-0.6, len(labels) - 0.4)
    axes.set_xlabel(xlabel)
    axes.set_ylabel("position error (m)")
    axes.set_ylim(bottom=0.0)
    axes.grid(visible=True, axis="y", color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    handles: list[Artist] = [Patch(facecolor=styles[n].colour, edgecolor="black", label=n) for n in names]
    if cumulative:
        handles.append(Line2D([], [], color="#666666", linewidth=1.2, label="mean over the runs so far"))
    axes.legend(
        handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize="small", frameon=False
    )
