"""Worlds that the simulated robot drives through, and the thesis's in particular.

A world's frame is the map frame: its origin is base_link's first pose.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from sim_backend.ground import GroundSpectrum, HeightField, random_ground
from sim_backend.solids import Solid

FloatArray = NDArray[np.float64]

#: Of the first sixty, the ground on which the tops of the objects stay furthest below the grid (4.7 cm): rods keep
#: within the 75 degrees that a calibration covers.
THESIS_GROUND_SEED = 32
#: Node distance of the ground, m: finer only slows contacts down, the shortest wave is ten times longer.
GROUND_CELL = 0.025
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
    """

    name: str
    ground: HeightField
    solids: tuple[Solid, ...]
    scenarios: dict[int, FloatArray]

    def height(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Height of the true surface, ground and objects, at (x, y), m, in the map frame."""
        px, py = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        z = self.ground.height(px, py)
        for solid in self.solids:
            z = np.maximum(z, solid.height(px, py))
        return z

    def scenario(self, number: int) -> FloatArray:
        """Waypoints of a scenario, shape (n, 3): x, y in m, heading in rad, unwrapped.

        Raises:
            WorldError: the world has no such scenario.
        """
        if number not in self.scenarios:
            known = ", ".join(map(str, self.scenarios))
            raise WorldError(f"world {self.name!r} has no scenario {number}, expected one of {known}")
        return self.scenarios[number]


def load(name: str) -> World:
    """A world by name.

    Raises:
        WorldError: no world of that name.
    """
    if name not in BUILT_IN:
        raise WorldError(f"no world is called {name!r}, expected one of {', '.join(BUILT_IN)}")
    return BUILT_IN[name]()


@cache
def thesis(seed: int = THESIS_GROUND_SEED) -> World:
    """The thesis's world: ground with a relief of 10 cm, brick, slide, pipe, stone and hemisphere.

    The grid's plane, z = 0, is one whisker length above the lowest ground that the array passes in any of the
    scenarios.
    """
    data = json.loads(files("sim_backend").joinpath("thesis_world.json").read_text(encoding="utf-8"))
    extent = tuple((float(a), float(b)) for a, b in data["ground"]["extent_m"])
    ground = random_ground(GroundSpectrum(seed, data["ground"]["relief_m"]), (extent[0], extent[1]), GROUND_CELL)
    points = data["points"]
    scenarios = {
        int(number): np.array([[*points[name], np.deg2rad(heading)] for name, heading in stops], dtype=np.float64)
        for number, stops in data["scenarios"].items()
    }
    passed = passed_ground(ground, list(scenarios.values()), ARRAY_REACH)
    ground = ground.shifted(-WHISKER_LENGTH - float(ground.z[passed].min()))
    bare = World("thesis", ground, (), scenarios)
    return replace(bare, solids=tuple(_solid(spec, ground) for spec in data["objects"]))


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


def _solid(spec: dict[str, Any], ground: HeightField) -> Solid:
    """An object of the world's file; `top_above_ground_m` is its highest point above the ground at its centre."""
    x, y = spec["centre_xy"]
    R = Rotation.from_euler("xyz", spec.get("rpy_deg", [0, 0, 0]), degrees=True).as_matrix()
    if spec["shape"] == "box":
        size = tuple(0.5 * length for length in spec["size_m"])
    elif spec["shape"] == "cylinder":
        size = (spec["radius_m"], 0.5 * spec["length_m"])
        R = Rotation.from_euler("x", -90.0, degrees=True).as_matrix()  # its axis, z, along y
    else:
        size = (spec["radius_m"],)
    solid = Solid(spec["name"], spec["shape"], size, np.array([x, y, 0.0]), R)
    top = float(ground.height(x, y)) + spec["top_above_ground_m"]
    return replace(solid, centre=np.array([x, y, top - solid.half_height()]))


BUILT_IN = {"thesis": thesis}
