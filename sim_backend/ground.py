"""Uneven ground as a height field of triangles, the same ones that the physics engine collides with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class HeightField:
    """A regular grid of heights; between its nodes the surface is two triangles per cell.

    Attributes:
        origin: x, y of node (0, 0), m.
        cell: distance of neighbouring nodes in x and y, m.
        z: heights of the nodes, shape (number in y, number in x), m.
    """

    origin: tuple[float, float]
    cell: float
    z: FloatArray

    @property
    def extent(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Range of x and range of y, m."""
        ny, nx = self.z.shape
        x, y = self.origin
        return (x, x + (nx - 1) * self.cell), (y, y + (ny - 1) * self.cell)

    def height(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Height of the surface at (x, y), m; outside the grid, that of the nearest edge.

        A cell's diagonal runs from its corner (0, 0) to its corner (1, 1), in grid units (x, y), as in
        MuJoCo's height fields, so that this is exactly the surface that contacts are computed with.
        """
        ny, nx = self.z.shape
        u = np.clip((np.asarray(x, dtype=np.float64) - self.origin[0]) / self.cell, 0.0, nx - 1)
        v = np.clip((np.asarray(y, dtype=np.float64) - self.origin[1]) / self.cell, 0.0, ny - 1)
        i = np.minimum(u.astype(np.intp), nx - 2)
        j = np.minimum(v.astype(np.intp), ny - 2)
        u, v = u - i, v - j
        z00, z10, z01, z11 = self.z[j, i], self.z[j, i + 1], self.z[j + 1, i], self.z[j + 1, i + 1]
        right = z00 + u * (z10 - z00) + v * (z11 - z10)
        left = z00 + u * (z11 - z01) + v * (z01 - z00)
        return np.where(u >= v, right, left)

    def shifted(self, dz: float) -> HeightField:
        """The same ground, higher by `dz` metres."""
        return HeightField(self.origin, self.cell, self.z + dz)


@dataclass(frozen=True, slots=True)
class GroundSpectrum:
    """Random ground as a sum of plane waves.

    Attributes:
        seed: draws directions, wavelengths and phases.
        relief: highest minus lowest point, m.
        shortest, longest: range of the wavelengths (their logarithm is uniform), m.
        exponent: amplitude grows as wavelength ** exponent: 0 is gravel, 1 is equally steep at all scales.
        waves: number of waves.
    """

    seed: int
    relief: float = 0.10
    shortest: float = 0.25
    longest: float = 1.5
    exponent: float = 0.6
    waves: int = 80


def random_ground(
    spectrum: GroundSpectrum, extent: tuple[tuple[float, float], tuple[float, float]], cell: float
) -> HeightField:
    """Ground of the given spectrum over an extent in x and y; its lowest point is at z = 0."""
    rng = np.random.default_rng(spectrum.seed)
    wavelength = np.exp(rng.uniform(np.log(spectrum.shortest), np.log(spectrum.longest), spectrum.waves))
    direction = rng.uniform(0.0, 2.0 * np.pi, spectrum.waves)
    phase = rng.uniform(0.0, 2.0 * np.pi, spectrum.waves)
    (x0, x1), (y0, y1) = extent
    x = np.linspace(x0, x1, round((x1 - x0) / cell) + 1)
    y = np.linspace(y0, y1, round((y1 - y0) / cell) + 1)
    z = np.zeros((len(y), len(x)))
    for length, angle, start in zip(wavelength, direction, phase, strict=True):
        k = 2.0 * np.pi / length
        z += length**spectrum.exponent * np.cos(
            k * (np.cos(angle) * x[None, :] + np.sin(angle) * y[:, None]) + start
        )
    z -= z.min()
    return HeightField((x0, y0), cell, z * (spectrum.relief / z.max()))
