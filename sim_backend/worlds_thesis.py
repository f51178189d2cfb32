"""The thesis's world: uneven ground, five objects from left to right, waypoints S and A to Q, five scenarios."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_backend.ground import GroundSpectrum, HeightField, random_ground
from sim_backend.scene import World, under_level_grid
from sim_backend.solids import Solid

FloatArray = NDArray[np.float64]
Extent = tuple[tuple[float, float], tuple[float, float]]

#: Of the first sixty, the ground on which the tops of the objects stay furthest below the grid (4.7 cm): rods keep
#: within the 75 degrees that a calibration covers.
THESIS_GROUND_SEED = 32
#: Node distance of the ground, m: finer only slows contacts down, the shortest wave is ten times longer.
GROUND_CELL = 0.025


@cache
def thesis(seed: int = THESIS_GROUND_SEED) -> World:
    """The thesis's world: ground with a relief of 10 cm, brick, slide, pipe, stone and hemisphere.

    The grid's plane, z = 0, is one whisker length above the lowest ground that the array passes in any of the
    scenarios.
    """
    data = _data()
    ground = random_ground(GroundSpectrum(seed, data["ground"]["relief_m"]), extent(), GROUND_CELL)
    driven = scenarios()
    ground = under_level_grid(ground, driven)
    return World("thesis", ground, tuple(_solid(spec, ground) for spec in data["objects"]), driven)


def extent() -> Extent:
    """Range of x and range of y that the scenarios need, m."""
    (x0, x1), (y0, y1) = _data()["ground"]["extent_m"]
    return (float(x0), float(x1)), (float(y0), float(y1))


def scenarios() -> dict[int, FloatArray]:
    """The five scenarios, each of shape (n, 3): x, y in m, heading in rad, unwrapped."""
    data = _data()
    points = data["points"]
    return {
        int(number): np.array([[*points[name], np.deg2rad(heading)] for name, heading in stops], dtype=np.float64)
        for number, stops in data["scenarios"].items()
    }


def _data() -> dict[str, Any]:
    data: dict[str, Any] = json.loads(files("sim_backend").joinpath("thesis_world.json").read_text(encoding="utf-8"))
    return data


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
