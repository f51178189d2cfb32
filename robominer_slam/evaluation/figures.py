"""The thesis's figures: path (figure 18), height map (17), pose graph (25). Colours are safe for the colour-blind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from robominer_slam.evaluation.pose_graph_errors import LEAST_WEIGHT
from robominer_slam.evaluation.report import DriveReport
from robominer_slam.evaluation.trajectory import Trajectory
from robominer_slam.mapping.height_grid import HeightGrid

FloatArray = NDArray[np.float64]

#: Okabe and Ito's palette.
TRUTH, ODOMETRY, SLAM, CLOSURE, WRONG = "#000000", "#E69F00", "#0072B2", "#009E73", "#D55E00"
#: Closures that the robust kernel has switched off.
UNUSED = "#999999"
DPI = 130
WIDTH_IN = 9.0
#: A straight drive still gets this much room across it, m.
MIN_SPAN_M = 0.9
MARGIN_M = 0.15
#: A closure is drawn as an arc this high: closures of a drive along a line would lie upon each other.
ARC_M = 0.25
#: Room for the legend between axes and title, points.
TITLE_PAD = 36.0
#: What a line of a legend has room for, and what each entry takes beside its text.
CHARACTERS_PER_INCH, SYMBOL_CHARACTERS = 13.6, 7


@dataclass(frozen=True)
class DriveData:
    """What the figures show: trajectories in map, the graph of `map/graph`, the touched heights, the errors."""

    truth: Trajectory
    odometry: Trajectory
    slam: Trajectory
    graph: Mapping[str, Any]
    grid: HeightGrid
    report: DriveReport


def draw_path(axes: Axes, data: DriveData) -> None:
    """Ground truth, odometry and SLAM from above."""
    for trajectory, colour, label, style, width in (
        (data.truth, TRUTH, "ground truth", "-", 2.4),
        (data.odometry, ODOMETRY, "odometry", "--", 1.4),
        (data.slam, SLAM, "SLAM, as published", "-", 1.1),
    ):
        axes.plot(trajectory.T[:, 0, 3], trajectory.T[:, 1, 3], style, color=colour, linewidth=width, label=label)
    axes.plot(*data.truth.T[0, :2, 3], "o", color=TRUTH, markersize=6, label="start")
    plan_axes(axes)


def draw_height_map(figure: Figure, axes: Axes, data: DriveData) -> None:
    """Mean height of the touches per cell; white where nothing was touched."""
    height_plan(figure, axes, data.grid)


def height_plan(figure: Figure, axes: Axes, grid: HeightGrid, limits: tuple[float, float] | None = None) -> None:
    """Heights of a grid, m, white where nothing was touched; `limits` of the colours, by default the grid's own."""
    ny, nx = grid.height.shape
    x0, y0 = grid.origin
    extent = (x0, x0 + nx * grid.cell, y0, y0 + ny * grid.cell)
    low, high = limits if limits is not None else (None, None)
    image = axes.imshow(
        grid.height, origin="lower", extent=extent, cmap="viridis", interpolation="nearest", vmin=low, vmax=high
    )
    plan_axes(axes, "box")
    axes.grid(visible=False)
    # Beside the axes and as high as they are, whatever their aspect.
    figure.colorbar(image, cax=axes.inset_axes((1.02, 0.0, 0.03, 1.0)), label="height in map (m)")


def draw_pose_graph(axes: Axes, data: DriveData) -> None:
    """Keyframes, odometry edges, and loop closures as arcs, the wrong ones apart."""
    graph_plan(axes, data.truth, data.graph, data.report.closures.wrong)


def graph_plan(axes: Axes, truth: Trajectory, graph: Mapping[str, Any], wrong: NDArray[np.bool_]) -> None:
    """The true path, keyframes, odometry edges, and loop closures as arcs.

    Args:
        axes: where.
        truth: the true path.
        graph: as `map/graph` has it.
        wrong: which of its loop closures are wrong, in their order, shape (n,).
    """
    axes.plot(truth.T[:, 0, 3], truth.T[:, 1, 3], color="#bbbbbb", linewidth=3.0, label="ground truth")
    position = {int(k["id"]): np.array(k["pose"][:2]) for k in graph["keyframes"]}
    odometry = [e for e in graph["edges"] if e["kind"] == "odometry"]
    loops = [e for e in graph["edges"] if e["kind"] == "loop"]
    judged = list(zip(loops, wrong, strict=True))
    groups: list[tuple[list[Any], str, str, float]] = [
        (odometry, SLAM, "odometry edges", 0.0),
        ([e for e, _ in judged if e["weight"] <= LEAST_WEIGHT], UNUSED, "closures without weight", ARC_M),
        ([e for e, bad in judged if not bad and e["weight"] > LEAST_WEIGHT], CLOSURE, "closures, right", ARC_M),
        ([e for e, bad in judged if bad and e["weight"] > LEAST_WEIGHT], WRONG, "closures, wrong", ARC_M),
    ]
    for group, colour, label, height in groups:
        lines = [_arc(position[int(e["i"])], position[int(e["j"])], height) for e in group]
        if lines:
            line = np.concatenate(lines)
            axes.plot(line[:, 0], line[:, 1], color=colour, linewidth=0.9, label=f"{label} ({len(group)})")
    if position:
        nodes = np.array(list(position.values()))
        axes.plot(nodes[:, 0], nodes[:, 1], ".", color=SLAM, markersize=5, label=f"keyframes ({len(nodes)})")
    plan_axes(axes)


def draw_errors(axes: Axes, data: DriveData) -> None:
    """Position errors over time."""
    start = int(data.truth.stamps_ns[0])
    for errors, colour, label, style in (
        (data.report.odometry, ODOMETRY, "odometry", "--"),
        (data.report.slam, SLAM, "SLAM, as published", "-"),
    ):
        axes.plot((errors.stamps_ns - start) * 1e-9, errors.position, style, color=colour, linewidth=1.2, label=label)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("position error (m)")
    axes.set_ylim(bottom=0.0)
    axes.grid(visible=True, color="#dddddd", linewidth=0.6)


def write_figures(folder: Path, data: DriveData, title: str) -> list[Path]:
    """Write path.png, height_map.png, pose_graph.png and overview.png, which has all of them."""
    written = []
    height = _plan_height(data)
    for name, draw in (("path", draw_path), ("pose_graph", draw_pose_graph)):
        figure, axes = plt.subplots(figsize=(WIDTH_IN, height), layout="constrained")
        draw(axes, data)
        legend_above(axes)
        axes.set_title(f"{name.replace('_', ' ').capitalize()}, {title}", pad=TITLE_PAD)
        written.append(_save(figure, folder / f"{name}.png"))
    figure, axes = plt.subplots(figsize=(WIDTH_IN, height), layout="constrained")
    draw_height_map(figure, axes, data)
    axes.set_title(f"Touched heights, {title}")
    written.append(_save(figure, folder / "height_map.png"))
    figure, rows = plt.subplots(
        4, 1, figsize=(WIDTH_IN, 3 * height + 2.4), height_ratios=[height, height, height, 2.4], layout="constrained"
    )
    draw_height_map(figure, rows[0], data)
    rows[0].set_title(f"What the whiskers have touched, {title}")
    draw_path(rows[1], data)
    draw_pose_graph(rows[2], data)
    draw_errors(rows[3], data)
    for axes in rows[1:]:
        legend_above(axes)
    written.append(_save(figure, folder / "overview.png"))
    return written


def path_figure(path: Path, data: DriveData, title: str) -> None:
    """The path alone."""
    figure, axes = plt.subplots(figsize=(WIDTH_IN, _plan_height(data)), layout="constrained")
    draw_path(axes, data)
    legend_above(axes)
    axes.set_title(title, pad=TITLE_PAD)
    _save(figure, path)


def plan_axes(axes: Axes, adjustable: Literal["box", "datalim"] = "datalim") -> None:
    """Equal axes in metres of map."""
    # The box of a path stays as it was laid out, its limits give way; the map's limits are the map's.
    axes.set_aspect("equal", adjustable=adjustable)
    axes.set_xlabel("x in map (m)")
    axes.set_ylabel("y in map (m)")
    axes.grid(visible=True, color="#dddddd", linewidth=0.6)


def _extent(trajectories: Sequence[Trajectory]) -> tuple[FloatArray, FloatArray]:
    xy = np.concatenate([trajectory.T[:, :2, 3] for trajectory in trajectories])
    low, high = xy.min(axis=0) - MARGIN_M, xy.max(axis=0) + MARGIN_M
    missing = np.maximum(MIN_SPAN_M - (high - low), 0.0) / 2.0
    return low - missing, high + missing


def _plan_height(data: DriveData) -> float:
    """Height in inches at which a plan view fills the width, within reason; the legend's lines included."""
    low, high = _extent([data.truth, data.odometry, data.slam])
    return float(np.clip((WIDTH_IN - 1.5) * (high[1] - low[1]) / (high[0] - low[0]) + 1.6, 3.2, 8.0))


def _arc(start: FloatArray, end: FloatArray, height: float) -> FloatArray:
    """A parabola between two points, shape (m, 2), ended by NaN so that many draw as one line.

    It is no higher than half of their distance: a closure between near keyframes is no spike.
    """
    height = min(height, 0.5 * float(np.linalg.norm(end - start)))
    share = np.linspace(0.0, 1.0, 12 if height else 2)[:, None]
    line = start + share * (end - start)
    line[:, 1:] += 4.0 * height * share * (1.0 - share)
    return np.concatenate([line, np.full((1, 2), np.nan)])


def legend_above(axes: Axes, handles: Sequence[Artist] | None = None) -> None:
    """The legend outside the axes, where it covers nothing; of the labelled artists, or of `handles`."""
    shown = axes.get_legend_handles_labels()[0] if handles is None else list(handles)
    longest = max((len(str(one.get_label())) for one in shown), default=0)
    room = CHARACTERS_PER_INCH * axes.figure.bbox.width / axes.figure.dpi
    columns = min(len(shown), max(1, int(room) // (longest + SYMBOL_CHARACTERS)), 4)
    axes.legend(
        handles=shown, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, fontsize="small", frameon=False
    )


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    return path
