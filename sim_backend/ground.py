"""Uneven ground as a smooth height field: the surface that whiskers touch and that maps are compared with."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

#: Quadratic B-spline: row k holds the coefficient of t^k in the weights of the three control points around t = 0.
SPLINE = np.array([[0.125, 0.75, 0.125], [-0.5, 0.0, 0.5], [0.5, -1.0, 0.5]])


@dataclass(frozen=True, slots=True)
class HeightField:
    """A smooth surface over a regular grid of nodes.

    It is the quadratic B-spline with the nodes' heights as control points: smooth in slope, so that a sliding rod
    finds no edges that the ground does not have, and local, so that it is cheap to evaluate.

    Attributes:
        origin: x, y of node (0, 0), m.
        cell: distance of neighbouring nodes in x and y, m.
        z: heights of the control points, shape (number in y, number in x), at least (3, 3), m.
        polynomial: around each node but those on the edge, the surface as sum of p[b, a] u^a v^b with u, v in
            cells from the node, -0.5 to 0.5; shape (number in y - 2, number in x - 2, 3, 3), m.
    """

    origin: tuple[float, float]
    cell: float
    z: FloatArray
    polynomial: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if min(self.z.shape) < 3:
            raise ValueError(f"a height field needs at least 3 x 3 nodes, found {self.z.shape}")
        near = np.lib.stride_tricks.sliding_window_view(self.z, (3, 3))
        polynomial = np.einsum("bj,yxji,ai->yxba", SPLINE, near, SPLINE)
        object.__setattr__(self, "polynomial", np.ascontiguousarray(polynomial))

    @property
    def extent(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Range of x and range of y, m."""
        ny, nx = self.z.shape
        x, y = self.origin
        return (x, x + (nx - 1) * self.cell), (y, y + (ny - 1) * self.cell)

    def height(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Height of the surface at (x, y), m; beyond the middle of the outermost cells, that of the nearest place."""
        p, u, v = self._patch(x, y)
        along_u = p[..., 0] + u[..., None] * (p[..., 1] + u[..., None] * p[..., 2])
        height: FloatArray = along_u[..., 0] + v * (along_u[..., 1] + v * along_u[..., 2])
        return height

    def height_and_normal(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Height of the surface, shape (n,), m, and its upward unit normal, shape (n, 3), at (x, y)."""
        p, u, v = self._patch(x, y)
        u2, v2 = u[:, None], v[:, None]
        along_u = p[:, :, 0] + u2 * (p[:, :, 1] + u2 * p[:, :, 2])
        along_v = p[:, 0] + v2 * (p[:, 1] + v2 * p[:, 2])
        normal = np.empty((len(u), 3))
        normal[:, 0] = (along_v[:, 1] + 2.0 * u * along_v[:, 2]) / -self.cell
        normal[:, 1] = (along_u[:, 1] + 2.0 * v * along_u[:, 2]) / -self.cell
        normal[:, 2] = 1.0
        normal /= np.sqrt((normal**2).sum(axis=1))[:, None]
        return along_u[:, 0] + v * (along_u[:, 1] + v * along_u[:, 2]), normal

    def _patch(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The polynomial at each place, shape (..., 3, 3), and the place in it."""
        ny, nx = self.z.shape
        u = np.clip((np.asarray(x, dtype=np.float64) - self.origin[0]) / self.cell, 0.5, nx - 1.5)
        v = np.clip((np.asarray(y, dtype=np.float64) - self.origin[1]) / self.cell, 0.5, ny - 1.5)
        i = np.minimum((u + 0.5).astype(np.intp), nx - 2)
        j = np.minimum((v + 0.5).astype(np.intp), ny - 2)
        return self.polynomial[j - 1, i - 1], u - i, v - j

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
        z += length**spectrum.exponent * np.cos(k * (np.cos(angle) * x[None, :] + np.sin(angle) * y[:, None]) + start)
    z -= z.min()
    return HeightField((x0, y0), cell, z * (spectrum.relief / z.max()))
