"""The thesis's figures: path (figure 18), height map (17), pose graph (25). Colours are safe for the colour-blind."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

mpl.use("Agg")
from matplotlib import pyplot as plt

from robominer_slam.evaluation.trajectory import Trajectory
from robominer_slam.mapping.height_grid import HeightGrid

FloatArray = NDArray[np.float64]

#: Okabe and Ito's palette.
TRUTH, ODOMETRY, SLAM, CLOSURE, WRONG = "#000000", "#E69F00", "#0072B2", "#009E73", "#D55E00"
DPI = 130


def _axes(title: str) -> tuple[Any, Any]:
    figure, axes = plt.subplots(figsize=(8.0, 5.2), layout="constrained")
    axes.set_aspect("equal")
    axes.set_xlabel("x in map (m)")
    axes.set_ylabel("y in map (m)")
    axes.set_title(title)
    axes.grid(visible=True, color="#dddddd", linewidth=0.6)
    return figure, axes


def _save(figure: Any, path: Path) -> None:  # noqa: ANN401 - matplotlib is untyped here
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def path_figure(path: Path, truth: Trajectory, odometry: Trajectory, slam: Trajectory, title: str) -> None:
    """Ground truth, odometry and SLAM from above."""
    figure, axes = _axes(title)
    for trajectory, colour, label, style, width in (
        (truth, TRUTH, "ground truth", "-", 2.2),
        (odometry, ODOMETRY, "odometry", "--", 1.3),
        (slam, SLAM, "SLAM, as published", "-", 1.1),
    ):
        axes.plot(trajectory.T[:, 0, 3], trajectory.T[:, 1, 3], style, color=colour, linewidth=width, label=label)
    axes.plot(*truth.T[0, :2, 3], "o", color=TRUTH, markersize=7, label="start")
    axes.legend(loc="best", framealpha=0.9)
    _save(figure, path)


def height_map_figure(path: Path, grid: HeightGrid, title: str) -> None:
    """Mean height of the touches per cell; white where nothing was touched."""
    figure, axes = _axes(title)
    ny, nx = grid.height.shape
    x0, y0 = grid.origin
    extent = (x0, x0 + nx * grid.cell, y0, y0 + ny * grid.cell)
    image = axes.imshow(grid.height, origin="lower", extent=extent, cmap="viridis", interpolation="nearest")
    figure.colorbar(image, ax=axes, label="height in map (m)", shrink=0.8)
    _save(figure, path)


def pose_graph_figure(
    path: Path, graph: Mapping[str, Any], wrong: NDArray[np.bool_], truth: Trajectory, title: str
) -> None:
    """Keyframes, odometry edges and loop closures, the wrong ones apart.

    Args:
        path: file to write.
        graph: answer of `map/graph`.
        wrong: of each loop edge, in the graph's order.
        truth: drawn thin beneath.
        title: of the figure.
    """
    figure, axes = _axes(title)
    axes.plot(truth.T[:, 0, 3], truth.T[:, 1, 3], color="#bbbbbb", linewidth=3.0, label="ground truth")
    position = {int(k["id"]): k["pose"][:2] for k in graph["keyframes"]}
    odometry = [e for e in graph["edges"] if e["kind"] == "odometry"]
    loops = [e for e in graph["edges"] if e["kind"] == "loop"]

    def draw(edges: list[Any], colour: str, width: float, label: str) -> None:
        x: list[float] = []
        y: list[float] = []
        for edge in edges:
            (xi, yi), (xj, yj) = position[int(edge["i"])], position[int(edge["j"])]
            x += [xi, xj, np.nan]
            y += [yi, yj, np.nan]
        if edges:
            axes.plot(x, y, color=colour, linewidth=width, label=f"{label} ({len(edges)})")

    draw(odometry, SLAM, 1.0, "odometry edges")
    draw([e for e, bad in zip(loops, wrong, strict=True) if not bad], CLOSURE, 1.0, "loop closures, right")
    draw([e for e, bad in zip(loops, wrong, strict=True) if bad], WRONG, 1.0, "loop closures, wrong")
    if position:
        nodes = np.array(list(position.values()))
        axes.plot(nodes[:, 0], nodes[:, 1], ".", color=SLAM, markersize=4, label=f"keyframes ({len(nodes)})")
    axes.legend(loc="best", framealpha=0.9)
    _save(figure, path)
