"""Heights of a part of a world, as pictures of it need them: ground, or galleries cut open at shoulder height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.scene import World
from sim_backend.touch_surface import Extent

FloatArray = NDArray[np.float64]

#: Galleries are cut open this high above base_link's first pose, m.
CUT_Z = 0.45
#: Height at which a wall is looked for, m: that of the wall whiskers' tips.
WALL_Z = 0.25
ROCK = np.array([70, 66, 62], dtype=np.uint8)
#: A line is drawn on the ground wherever the height passes a multiple of this, m.
CONTOUR = 0.02
#: Ground is grey, dark where low, so that coloured rods stand out; a little of sand's colour.
DARKEST, BRIGHTEST = 0.4, 0.95
SAND = np.array([1.0, 0.96, 0.88])


@dataclass(frozen=True, slots=True)
class ViewHeights:
    """Heights over a regular grid.

    Attributes:
        extent: range of x and range of y, m.
        z: heights, shape (number in y, number in x), m; rock that was cut has CUT_Z.
        rock: which places are inside of the rock, shape of z.
    """

    extent: Extent
    z: FloatArray
    rock: NDArray[np.bool_]

    @classmethod
    def of(cls, world: World, extent: Extent, cells: int = 500) -> ViewHeights:
        """Sample a world over an extent, `cells` nodes along its longer side."""
        (x0, x1), (y0, y1) = extent
        step = max(x1 - x0, y1 - y0) / cells
        x = np.linspace(x0, x1, max(round((x1 - x0) / step), 2))
        y = np.linspace(y0, y1, max(round((y1 - y0) / step), 2))
        px, py = np.meshgrid(x, y)
        if world.walls is None:
            # Solids are drawn as solids in 3D and stand out of the map from above by their own heights.
            return cls(extent, world.ground.height(px, py), np.zeros(px.shape, dtype=np.bool_))
        z = world.height(px, py)
        gap, _ = world.walls.gap(np.stack([px.ravel(), py.ravel(), np.full(px.size, WALL_Z)]))
        rock = gap.reshape(px.shape) < 0.0
        return cls(extent, np.where(rock, CUT_Z, z), rock)

    def greys(self, pixels: int) -> NDArray[np.uint8]:
        """Greys by height with contour lines, shape (pixels, pixels, 3), first row at the lowest y."""
        ny, nx = self.z.shape
        row = np.linspace(0, ny - 1, pixels).round().astype(np.intp)
        column = np.linspace(0, nx - 1, pixels).round().astype(np.intp)
        z, rock = self.z[np.ix_(row, column)], self.rock[np.ix_(row, column)]
        open_ground = z[~rock]
        low, high = (float(open_ground.min()), float(open_ground.max())) if open_ground.size else (0.0, 0.0)
        share = np.clip((z - low) / max(high - low, 1e-6), 0.0, 1.0)
        grey = (DARKEST + (BRIGHTEST - DARKEST) * share)[..., None] * SAND
        level = np.floor(z / CONTOUR)
        line = np.zeros(z.shape, dtype=np.bool_)
        line[1:] |= level[1:] != level[:-1]
        line[:, 1:] |= level[:, 1:] != level[:, :-1]
        grey[line] *= 0.75
        image: NDArray[np.uint8] = np.round(255.0 * grey).astype(np.uint8)
        image[rock] = ROCK
        return image
