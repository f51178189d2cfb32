"""Worlds from a seed or a rule, with the thesis's scenarios: random ground and objects, flat, corridor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_backend.ground import GroundSpectrum, HeightField, random_ground
from sim_backend.scene import WHISKER_LENGTH, World, under_level_grid
from sim_backend.solids import Solid
from sim_backend.worlds_thesis import GROUND_CELL, extent, scenarios

FloatArray = NDArray[np.float64]

#: Grounds that `random:<seed>` draws from, smooth to gravel; relief is at most 10 cm, as the grid is level.
SPECTRA = {
    "smooth": {"relief": 0.08, "shortest": 0.6, "longest": 2.5, "exponent": 1.0},
    "fractal": {"relief": 0.10, "shortest": 0.2, "longest": 3.0, "exponent": 1.0},
    "rough": {"relief": 0.10, "shortest": 0.2, "longest": 1.0, "exponent": 0.5},
    "gravel": {"relief": 0.05, "shortest": 0.12, "longest": 0.4, "exponent": 0.2},
}
#: No top stands higher than this, m: rods keep within 73 deg.
HIGHEST_TOP = -0.045
#: Objects keep this far from the start, m: the array comes down there.
CLEAR_START = 0.35


def random_world(seed: int) -> World:
    """Other ground and three to eight other objects under the thesis's scenarios; the seed decides everything."""
    rng = np.random.default_rng([seed, 7])
    kind = tuple(SPECTRA)[int(rng.integers(len(SPECTRA)))]
    spectrum = GroundSpectrum(seed, waves=120, **SPECTRA[kind])
    # The surface is smooth over some nodes per wave.
    cell = min(GROUND_CELL, spectrum.shortest / 8.0)
    driven = scenarios()
    ground = under_level_grid(random_ground(spectrum, extent(), cell), driven)
    return World(f"random:{seed}", ground, tuple(_random_solids(rng, ground)), driven)


def flat(pressed: float = 0.02) -> World:
    """Perfectly flat ground, closer to the grid by `pressed` metres than a whisker is long: nothing to match on."""
    return World("flat", _along_x(np.full(len(_nodes_y()), pressed - WHISKER_LENGTH)), (), scenarios())


def corridor(seed: int = 5, relief: float = 0.06) -> World:
    """Ridges that run along x: the ground tells y and heading, and never x."""
    rng = np.random.default_rng(seed)
    wavelength = np.exp(rng.uniform(np.log(0.25), np.log(1.0), 12))
    phase = rng.uniform(0.0, 2.0 * np.pi, 12)
    waves = np.cos(2.0 * np.pi * _nodes_y()[:, None] / wavelength + phase)
    z = waves @ np.sqrt(wavelength)
    driven = scenarios()
    ground = _along_x((z - z.min()) * (relief / np.ptp(z)))
    return World("corridor", under_level_grid(ground, driven), (), driven)


def _along_x(z_of_y: FloatArray) -> HeightField:
    """Ground that has the same profile, heights at nodes along y, at every x."""
    (x0, x1), (y0, _) = extent()
    nx = round((x1 - x0) / GROUND_CELL) + 1
    return HeightField((x0, y0), GROUND_CELL, np.repeat(z_of_y[:, None], nx, axis=1))


def _nodes_y() -> FloatArray:
    _, (y0, y1) = extent()
    return np.linspace(y0, y1, round((y1 - y0) / GROUND_CELL) + 1)


def _random_solids(rng: np.random.Generator, ground: HeightField) -> list[Solid]:
    """Boxes, cylinders and spheres where the scenarios pass, apart from each other, none above HIGHEST_TOP."""
    wanted = int(rng.integers(3, 9))
    solids: list[Solid] = []
    for _ in range(200):
        if len(solids) == wanted:
            break
        x, y = rng.uniform(0.2, 3.2), rng.uniform(-0.5, 1.4)
        top = min(float(ground.height(x, y)) + rng.uniform(0.03, 0.07), HIGHEST_TOP)
        near = any(np.hypot(*(solid.centre[:2] - [x, y])) < 0.45 for solid in solids)
        if near or np.hypot(x, y) < CLEAR_START or top < float(ground.height(x, y)) + 0.02:
            continue
        solid = _random_solid(rng, f"object_{len(solids)}", x, y)
        solids.append(replace(solid, centre=np.array([x, y, top - solid.half_height()])))
    return solids


def _random_solid(rng: np.random.Generator, name: str, x: float, y: float) -> Solid:
    shape = ("box", "cylinder", "sphere")[int(rng.integers(3))]
    tilt = rng.normal(0.0, 8.0, 2)
    R = Rotation.from_euler("xyz", [*tilt, rng.uniform(0.0, 360.0)], degrees=True)
    size: tuple[float, ...]
    if shape == "box":
        size = (rng.uniform(0.08, 0.2), rng.uniform(0.08, 0.2), rng.uniform(0.04, 0.08))
    elif shape == "cylinder":
        size = (rng.uniform(0.04, 0.1), rng.uniform(0.1, 0.4))
        R = R * Rotation.from_euler("x", 90.0, degrees=True)  # lying
    else:
        size = (rng.uniform(0.08, 0.2),)
    return Solid(name, shape, size, np.array([x, y, 0.0]), R.as_matrix())
