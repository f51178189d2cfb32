"""Galleries underground: streets between junctions, with rough floor and walls, as a surface that tips can touch."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Distances from the streets are sampled this finely, m; between nodes they are linear along straight walls.
CELL = 0.04
#: Beyond this distance from the middle of a street everything is rock, m.
SOLID = 1.0


@dataclass(frozen=True, slots=True)
class Roughness:
    """A sum of plane waves in space, with zero mean and a standard deviation of `deviation` metres.

    Attributes:
        wave: wave vectors, shape (m, 3), rad/m.
        phase: shape (m,), rad.
        amplitude: shape (m,), m.
    """

    wave: FloatArray
    phase: FloatArray
    amplitude: FloatArray

    @classmethod
    def random(
        cls, rng: np.random.Generator, deviation: float, shortest: float, longest: float, waves: int = 16
    ) -> Roughness:
        """Waves of random directions; the logarithm of the length is uniform, the amplitude grows as its root."""
        length = np.exp(rng.uniform(np.log(shortest), np.log(longest), waves))
        direction = rng.normal(size=(waves, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        amplitude = np.sqrt(length)
        amplitude *= deviation * np.sqrt(2.0 / np.square(amplitude).sum())
        phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        return cls(2.0 * np.pi / length[:, None] * direction, phase, amplitude)

    def level(self) -> Roughness:
        """The same waves running horizontally: roughness of a floor, the same at all heights."""
        wave = self.wave.copy()
        turned = np.linalg.norm(wave, axis=1) / np.linalg.norm(wave[:, :2], axis=1)
        wave[:, :2] *= turned[:, None]
        wave[:, 2] = 0.0
        return Roughness(wave, self.phase, self.amplitude)

    def value(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Value at points of shape (3, n), shape (n,), m, and gradient, shape (3, n)."""
        angle = self.wave @ p + self.phase[:, None]
        return self.amplitude @ np.cos(angle), -(self.wave * self.amplitude[:, None]).T @ np.sin(angle)


@dataclass(frozen=True, slots=True)
class Galleries:
    """Streets of equal width between junctions that are widened to chambers; an instance is a `Surface`.

    Attributes:
        nodes: junctions and ends, shape (n, 2), m.
        edges: streets as pairs of nodes, shape (m, 2).
        width: of a street, m.
        chamber: radius around a node, m; the robot turns there.
        floor_z: mean height of the floor, m.
        floor, wall: roughness; a positive wall value widens the street.
        start: place around which the floor is level, so that the map's axes are the robot's, shape (2,), m.
    """

    nodes: FloatArray
    edges: NDArray[np.intp]
    width: float
    chamber: float
    floor_z: float
    floor: Roughness
    wall: Roughness
    start: FloatArray
    _origin: FloatArray = field(init=False, repr=False)
    _distance: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        low, high = self.nodes.min(axis=0) - SOLID - 0.2, self.nodes.max(axis=0) + SOLID + 0.2
        nx, ny = np.ceil((high - low) / CELL).astype(int) + 1
        distance = np.full((ny, nx), SOLID)
        x, y = low[0] + CELL * np.arange(nx), low[1] + CELL * np.arange(ny)
        for a, b in [*self.nodes[self.edges], *((node, node) for node in self.nodes)]:
            # Around a node the chamber's wall counts as the street's, farther out.
            shift = self.chamber - self.width / 2.0 if (a == b).all() else 0.0
            first = np.maximum(((np.minimum(a, b) - SOLID - shift - low) / CELL).astype(int), 0)
            last = ((np.maximum(a, b) + SOLID + shift - low) / CELL).astype(int) + 2
            part = (slice(first[1], last[1]), slice(first[0], last[0]))
            near = _segment_distance(x[part[1]][None, :], y[part[0]][:, None], a, b) - shift
            distance[part] = np.minimum(distance[part], near)
        object.__setattr__(self, "_origin", low[:, None])
        object.__setattr__(self, "_distance", distance)

    @property
    def length(self) -> float:
        """Length of all streets, m."""
        a, b = self.nodes[self.edges[:, 0]], self.nodes[self.edges[:, 1]]
        return float(np.linalg.norm(b - a, axis=1).sum())

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the floor, m."""
        px, py = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        p = np.stack([px.ravel(), py.ravel(), np.zeros(px.size)])
        height: FloatArray = -self._floor_gap(p)[0].reshape(px.shape)
        return height

    def gap(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The nearer of floor and wall (see `touch_surface.Surface`)."""
        gap, gradient = self._floor_gap(p)
        beside, outward = self._wall_gap(p)
        wall = beside < gap
        return np.where(wall, beside, gap), np.where(wall, outward, gradient)

    def _floor_gap(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Height above the floor, whose relief sets in between 1 and 2 m from the start."""
        rough, slope = self.floor.value(p)
        away = p[:2] - self.start[:, None]
        distance = np.sqrt(away[0] ** 2 + away[1] ** 2)
        s = np.minimum(np.maximum(distance - 1.0, 0.0), 1.0)
        share, change = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s)
        gradient = -share * slope
        gradient[:2] -= rough * change * away / np.maximum(distance, 1e-9)
        gradient[2] += 1.0
        return p[2] - self.floor_z - share * rough, gradient

    def _wall_gap(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distance to the wall: half the width and its roughness less the distance from the street's middle."""
        rows, columns = self._distance.shape
        place = np.maximum((p[:2] - self._origin) / CELL, 0.0)
        place = np.minimum(place, [[columns - 1.001], [rows - 1.001]])
        i, j = place.astype(np.intp)
        u, v = place[0] - i, place[1] - j
        table = self._distance
        d00, d10, d01, d11 = table[j, i], table[j, i + 1], table[j + 1, i], table[j + 1, i + 1]
        along_x, along_y = d10 - d00 + v * (d11 - d01 - d10 + d00), d01 - d00 + u * (d11 - d01 - d10 + d00)
        rough, gradient = self.wall.value(p)
        gradient[0] -= along_x / CELL
        gradient[1] -= along_y / CELL
        return self.width / 2.0 + rough - d00 - u * along_x - v * (d01 - d00), gradient


def _segment_distance(x: FloatArray, y: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Distance of places from the segment a-b, m."""
    d = b - a
    square = float(d @ d)
    share = np.clip(((x - a[0]) * d[0] + (y - a[1]) * d[1]) / square, 0.0, 1.0) if square else 0.0
    distance: FloatArray = np.hypot(x - a[0] - share * d[0], y - a[1] - share * d[1])
    return distance
