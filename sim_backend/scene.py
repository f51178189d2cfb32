"""A scene to drive through: ground, objects, scenarios, and how a level grid is hung over it.

A world's frame is the map frame: its origin is base_link's first pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_backend.ground import HeightField
from sim_backend.solids import Solid
from sim_backend.touch_surface import HeightFunction, Surface
from sim_backend.water import Water

FloatArray = NDArray[np.float64]

#: Half the diagonal of the thesis's array: ground within this of the path is passed by some whisker, m.
ARRAY_REACH = 0.29
WHISKER_LENGTH = 0.15


class WorldError(ValueError):
    """A world or scenario that does not exist; the message names those that do."""


@dataclass(frozen=True, slots=True)
class World:
    """Ground, objects and the scenarios driven there.

    Attributes:
        name: the world's name.
        ground: the ground in the map frame; with `thesis-grid`, z = 0 is the grid's plane.
        solids: the objects on it.
        scenarios: waypoints by scenario number, each of shape (n, 3): x, y in m, heading in rad, unwrapped.
        layout: the array that the world is made for.
        walls: floor and walls of a gallery, where a height field cannot tell them; `ground` is then the floor
            around the start only.
        floor: height of the floor everywhere, which the body follows; None where the body is held level.
        water: what the whiskers move through, with mud above the true surface; None for air.
    """

    name: str
    ground: HeightField
    solids: tuple[Solid, ...]
    scenarios: dict[int, FloatArray]
    layout: str = "thesis-grid"
    walls: Surface | None = None
    floor: HeightFunction | None = None
    water: Water | None = None

    def height(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Height of the true surface, ground and objects without mud, at (x, y), m."""
        px, py = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        if self.floor is not None:
            return self.floor(px, py)
        z = self.ground.height(px, py)
        for solid in self.solids:
            z = np.maximum(z, solid.height(px, py))
        return z

    def scenario(self, number: int) -> FloatArray:
        """Waypoints of a scenario, shape (n, 3): x, y in m, heading in rad, unwrapped.

        Scenario 0, in every world, is the start alone.

        Raises:
            WorldError: the world has no such scenario.
        """
        if number == 0:
            return next(iter(self.scenarios.values()))[:1]
        if number not in self.scenarios:
            known = ", ".join(map(str, self.scenarios))
            raise WorldError(f"world {self.name!r} has no scenario {number}, expected one of {known}, or 0")
        return self.scenarios[number]


def under_level_grid(ground: HeightField, scenarios: dict[int, FloatArray]) -> HeightField:
    """The ground moved in height so that the lowest place the array passes is a whisker's length below z = 0."""
    passed = passed_ground(ground, list(scenarios.values()), ARRAY_REACH)
    return ground.shifted(-WHISKER_LENGTH - float(ground.z[passed].min()))


def passed_ground(ground: HeightField, paths: list[FloatArray], reach: float) -> NDArray[np.bool_]:
    """Which nodes of the ground lie within `reach` metres of the legs of any path; shape of `ground.z`."""
    ny, nx = ground.z.shape
    x = ground.origin[0] + ground.cell * np.arange(nx)[None, :]
    y = ground.origin[1] + ground.cell * np.arange(ny)[:, None]
    passed = np.zeros(ground.z.shape, dtype=np.bool_)
    legs = {tuple(np.concatenate([a[:2], b[:2]])) for path in paths for a, b in pairwise(path)}
    for ax, ay, bx, by in legs:
        dx, dy = bx - ax, by - ay
        square = dx * dx + dy * dy
        share = np.clip(((x - ax) * dx + (y - ay) * dy) / square, 0.0, 1.0) if square else 0.0
        passed |= np.hypot(x - ax - share * dx, y - ay - share * dy) <= reach
    return passed
