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
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from robominer_slam.evaluation.report import DriveReport
from robominer_slam.evaluation.trajectory import Trajectory
from robominer_slam.mapping.height_grid import HeightGrid

FloatArray = NDArray[np.float64]

#: Okabe and Ito's palette.
TRUTH, ODOMETRY, SLAM, CLOSURE, WRONG = "#000000", "#E69F00", "#0072B2", "#009E73", "#D55E00"
DPI = 130
WIDTH_IN = 9.0
#: A straight drive still gets this much room across it, m.
MIN_SPAN_M = 0.9
MARGIN_M = 0.15
#: A closure is drawn as an arc this high: closures of a drive along a line would lie upon each other.
ARC_M = 0.25
#: Room for the legend between axes and title, points.
TITLE_PAD = 36.0


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
    _plan(axes)


def draw_height_map(figure: Figure, axes: Axes, data: DriveData) -> None:
    """Mean height of the touches per cell; white where nothing was touched."""
    ny, nx = data.grid.height.shape
    x0, y0 = data.grid.origin
    extent = (x0, x0 + nx * data.grid.cell, y0, y0 + ny * data.grid.cell)
    image = axes.imshow(data.grid.height, origin="lower", extent=extent, cmap="viridis", interpolation="nearest")
    figure.colorbar(image, ax=axes, label="height in map (m)", shrink=0.9)
    _plan(axes, "box")


def draw_pose_graph(axes: Axes, data: DriveData) -> None:
    """Keyframes, odometry edges, and loop closures as arcs, the wrong ones apart."""
    axes.plot(data.truth.T[:, 0, 3], data.truth.T[:, 1, 3], color="#bbbbbb", linewidth=3.0, label="ground truth")
    position = {int(k["id"]): np.array(k["pose"][:2]) for k in data.graph["keyframes"]}
    edges = data.graph["edges"]
    odometry = [e for e in edges if e["kind"] == "odometry"]
    loops = [e for e in edges if e["kind"] == "loop"]
    wrong = data.report.closures.wrong
    groups: list[tuple[list[Any], str, str, float]] = [
        (odometry, SLAM, "odometry edges", 0.0),
        ([e for e, bad in zip(loops, wrong, strict=True) if not bad], CLOSURE, "loop closures, right", ARC_M),
        ([e for e, bad in zip(loops, wrong, strict=True) if bad], WRONG, "loop closures, wrong", ARC_M),
    ]
    for group, colour, label, height in groups:
        lines = [_arc(position[int(e["i"])], position[int(e["j"])], height) for e in group]
        if lines:
            line = np.concatenate(lines)
            axes.plot(line[:, 0], line[:, 1], color=colour, linewidth=0.9, label=f"{label} ({len(group)})")
    if position:
        nodes = np.array(list(position.values()))
        axes.plot(nodes[:, 0], nodes[:, 1], ".", color=SLAM, markersize=5, label=f"keyframes ({len(nodes)})")
    _plan(axes)


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
        _legend(axes)
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
        _legend(axes)
    written.append(_save(figure, folder / "overview.png"))
    return written


def path_figure(path: Path, data: DriveData, title: str) -> None:
    """The path alone."""
    figure, axes = plt.subplots(figsize=(WIDTH_IN, _plan_height(data)), layout="constrained")
    draw_path(axes, data)
    _legend(axes)
    axes.set_title(title, pad=TITLE_PAD)
    _save(figure, path)


def _plan(axes: Axes, adjustable: Literal["box", "datalim"] = "datalim") -> None:
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
    """A parabola between two points, shape (m, 2), ended by NaN so that many draw as one line."""
    share = np.linspace(0.0, 1.0, 12 if height else 2)[:, None]
    line = start + share * (end - start)
    line[:, 1:] += 4.0 * height * share * (1.0 - share)
    return np.concatenate([line, np.full((1, 2), np.nan)])


def _legend(axes: Axes) -> None:
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize="small", frameon=False)


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    return path
