"""The occupancy grid as ROS keeps it on disk: a PGM image and a YAML file beside it (nav2_map_server)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.mapping.height_grid import FREE, OCCUPIED, HeightGrid

#: Grey values that `map_server` reads back as free, occupied and unknown in mode `trinary`.
GREY_FREE, GREY_OCCUPIED, GREY_UNKNOWN = 254, 0, 205


def pgm(cells: NDArray[np.int8]) -> bytes:
    """The image, y up; `cells` as of `height_grid.occupancy`, shape (ny, nx)."""
    grey = np.full(cells.shape, GREY_UNKNOWN, dtype=np.uint8)
    grey[cells == FREE] = GREY_FREE
    grey[cells == OCCUPIED] = GREY_OCCUPIED
    ny, nx = cells.shape
    return f"P5\n{nx} {ny}\n255\n".encode() + np.ascontiguousarray(grey[::-1]).tobytes()


def yaml(grid: HeightGrid, image: str) -> str:
    """The description; `image` is the PGM file's name, relative to it."""
    x, y = grid.origin
    return (
        f"image: {image}\nmode: trinary\nresolution: {grid.cell:.9g}\norigin: [{x:.9g}, {y:.9g}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
