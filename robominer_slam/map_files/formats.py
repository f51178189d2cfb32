"""Which formats a saved map can be written in, and the files of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.map_files import graph_files, height_images, octomap, point_files, ros_grid
from robominer_slam.mapping.height_grid import height_grid, occupancy
from robominer_slam.slam.saved_map import SavedMap

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ExportSettings:
    """Sizes, m: cells of height maps and grids, cells of the octree, and the step that makes an obstacle."""

    cell: float
    octree_cell: float
    obstacle_height: float


#: From a map, the path that was asked for, and sizes, to the files and their contents.
Writer = Callable[[SavedMap, Path, ExportSettings], dict[Path, bytes]]


def cloud(saved: SavedMap) -> FloatArray:
    """All touches in map, shape (m, 3), m."""
    parts = [
        geometry.transform_points(T, keyframe.points) for T, keyframe in zip(saved.poses, saved.keyframes, strict=True)
    ]
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def _grid(saved: SavedMap, path: Path, settings: ExportSettings) -> dict[Path, bytes]:
    grid = height_grid(cloud(saved), settings.cell)
    image = path.with_suffix(".pgm")
    return {
        image: ros_grid.pgm(occupancy(grid, settings.obstacle_height)),
        path: ros_grid.yaml(grid, image.name).encode(),
    }


#: By the ending of the file's name.
FORMATS: dict[str, tuple[str, Writer]] = {
    ".ply": ("points, PLY", lambda saved, path, _: {path: point_files.ply(cloud(saved))}),
    ".pcd": ("points, PCD", lambda saved, path, _: {path: point_files.pcd(cloud(saved))}),
    ".bt": (
        "occupied cells, OctoMap",
        lambda saved, path, settings: {path: octomap.binary_tree(cloud(saved), settings.octree_cell)},
    ),
    ".png": (
        "height map, a picture",
        lambda saved, path, s: {path: height_images.picture(height_grid(cloud(saved), s.cell), f"map {saved.name}")},
    ),
    ".tif": (
        "height map, GeoTIFF",
        lambda saved, path, settings: {path: height_images.geotiff(height_grid(cloud(saved), settings.cell))},
    ),
    ".yaml": ("occupancy grid for ROS, with a .pgm beside it", _grid),
    ".tum": ("keyframes' poses, TUM", lambda saved, path, _: {path: graph_files.tum(saved).encode()}),
    ".g2o": ("pose graph, g2o", lambda saved, path, _: {path: graph_files.g2o(saved).encode()}),
}
