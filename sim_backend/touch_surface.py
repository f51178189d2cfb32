"""The surface that rods lie on, as a function whose zero it is: fast enough to be asked for every frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_backend.ground import HeightField

FloatArray = NDArray[np.float64]

#: Heights at places x, y of equal shape, m.
HeightFunction = Callable[[FloatArray, FloatArray], FloatArray]
#: Range of x and range of y, m.
Extent = tuple[tuple[float, float], tuple[float, float]]

#: Node distance of the sampled surface, m: the edges of objects become ramps of this width, and on ground that
#: curves by 1 mm over 20 mm the chords lie within 0.02 mm.
SAMPLING = 0.005


#: A part's value at points and its gradient there.
Part = tuple[FloatArray, FloatArray]


class Surface(Protocol):
    """What a rod can touch: positive in the open, zero on the surface, negative inside."""

    def gap(self, p: FloatArray) -> Part:
        """Value at points of shape (3, n), m, shape (n,), and its gradient there, shape (3, n), not normalised."""

    def parts(self, p: FloatArray) -> tuple[Part, ...]:
        """The same of each smooth part, such as floor and wall, always in the same order; `gap` is the smallest.

        Between two parts may be a corner in which a rod's end touches both.
        """


class SmoothHeight:
    """The ground alone, without objects, exactly as the height field has it: its value is the distance near it."""

    def __init__(self, ground: HeightField) -> None:
        """The surface of this ground."""
        self._ground = ground

    def gap(self, p: FloatArray) -> Part:
        """See `Surface.gap`."""
        height, normal = self._ground.height_and_normal(p[0], p[1])
        return (p[2] - height) * normal[:, 2], normal.T

    def parts(self, p: FloatArray) -> tuple[Part, ...]:
        """See `Surface.parts`."""
        return (self.gap(p),)


class SampledHeight:
    """Ground and objects as one height field, bilinear between nodes 5 mm apart: z - height(x, y)."""

    def __init__(self, height: HeightFunction, extent: Extent, cell: float = SAMPLING) -> None:
        """Sample `height` over ranges of x and y, m; beyond, the edge's height goes on."""
        (x0, x1), (y0, y1) = extent
        x, y = np.arange(x0, x1 + cell / 2, cell), np.arange(y0, y1 + cell / 2, cell)
        z = height(*np.meshgrid(x, y))
        self._start = np.array([[x0], [y0]])
        self._scale = 1.0 / cell
        self._last = np.array([[len(x) - 2 + 1 - 1e-9], [len(y) - 2 + 1 - 1e-9]])
        self._width = len(x) - 1
        dx, dy = np.diff(z, axis=1)[:-1], np.diff(z, axis=0)[:, :-1]
        twist = z[1:, 1:] - z[1:, :-1] - dx
        self._table = np.stack([z[:-1, :-1], dx, dy, twist], axis=-1).reshape(-1, 4)

    def parts(self, p: FloatArray) -> tuple[Part, ...]:
        """See `Surface.parts`."""
        return (self.gap(p),)

    def gap(self, p: FloatArray) -> Part:
        """See `Surface.gap`."""
        place = (p[:2] - self._start) * self._scale
        np.minimum(np.maximum(place, 0.0, out=place), self._last, out=place)
        whole = place.astype(np.intp)
        place -= whole
        u, v = place
        patch = self._table.take(whole[1] * self._width + whole[0], axis=0).T
        z, _, dy, twist = patch
        gradient = np.empty_like(p)
        gradient[2] = 1.0
        slope = gradient[:2]
        np.multiply(twist, place[::-1], out=slope)
        slope += patch[1:3]
        height = z + u * slope[0]
        height += v * dy
        slope *= -self._scale
        return p[2] - height, gradient
