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

    def value(self, p: FloatArray) -> FloatArray:
        """Value at points of shape (3, n), shape (n,), m."""
        value: FloatArray = self.amplitude @ np.cos(self.wave @ p + self.phase[:, None])
        return value


@dataclass(frozen=True, slots=True)
class TwoRoughnesses:
    """Two roughnesses evaluated together, with half the calls of numpy and sines in single precision.

    The surface that tips touch is right to nanometres then. That is enough for tips, but not for the accelerations
    of a body that follows the floor: those are second differences, and take `Roughness.value`.

    Attributes:
        turns: wave vectors, turns/m, and phases, turns, as one matrix, shape (m, 4).
        amplitude: shape (2, m), m, zero where a wave belongs to the other.
        slope: -amplitude * wave, shape (6, m).
    """

    turns: FloatArray
    amplitude: FloatArray | NDArray[np.float32]
    slope: FloatArray | NDArray[np.float32]

    @classmethod
    def of(cls, first: Roughness, second: Roughness, precision: type[np.floating] = np.float32) -> TwoRoughnesses:
        """The waves of both, to be evaluated in a precision."""
        wave = np.concatenate([first.wave, second.wave])
        amplitude = np.zeros((2, len(wave)))
        amplitude[0, : len(first.wave)], amplitude[1, len(first.wave) :] = first.amplitude, second.amplitude
        slope = -(amplitude[:, None, :] * wave.T).reshape(6, -1)
        turns = np.column_stack([wave, np.concatenate([first.phase, second.phase])]) / (2.0 * np.pi)
        return cls(turns, amplitude.astype(precision), slope.astype(precision))

    def value_and_gradient(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values at points of shape (3, n), shape (2, n), m, and gradients, shape (2, 3, n)."""
        turns = self.turns[:, :3] @ p + self.turns[:, 3:]
        # Whole turns go before precision is lost.
        turns -= np.rint(turns)
        angle = (2.0 * np.pi * turns).astype(self.amplitude.dtype)
        value = (self.amplitude @ np.cos(angle)).astype(np.float64)
        gradient = (self.slope @ np.sin(angle)).astype(np.float64)
        return value, gradient.reshape(2, 3, -1)


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
    _rough: TwoRoughnesses = field(init=False, repr=False)

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
        object.__setattr__(self, "_rough", TwoRoughnesses.of(self.floor, self.wall))

    @property
    def length(self) -> float:
        """Length of all streets, m."""
        a, b = self.nodes[self.edges[:, 0]], self.nodes[self.edges[:, 1]]
        return float(np.linalg.norm(b - a, axis=1).sum())

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the floor, m."""
        px, py = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        p = np.stack([px.ravel(), py.ravel(), np.zeros(px.size)])
        share = self._relief(p)[0]
        height: FloatArray = (self.floor_z + share * self.floor.value(p)).reshape(px.shape)
        return height

    def gap(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The nearer of floor and wall (see `touch_surface.Surface`)."""
        (gap, gradient), (beside, outward) = self.parts(p)
        wall = beside < gap
        return np.where(wall, beside, gap), np.where(wall, outward, gradient)

    def parts(self, p: FloatArray) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Floor and wall, each on its own (see `touch_surface.Surface`)."""
        rough, slope = self._rough.value_and_gradient(p)
        return self._floor_gap(p, rough[0], slope[0]), self._wall_gap(p, rough[1], slope[1])

    def _floor_gap(self, p: FloatArray, rough: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Height above the floor."""
        share, change, direction = self._relief(p)
        slope *= -share
        slope[:2] -= rough * change * direction
        slope[2] += 1.0
        return p[2] - self.floor_z - share * rough, slope

    def _relief(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How much of the floor's relief there is: it sets in between 1 and 2 m from the start.

        Returns:
            Share, its change per metre away from the start, shape (n,), and the direction away, shape (2, n).
        """
        away = p[:2] - self.start[:, None]
        distance = np.sqrt(away[0] ** 2 + away[1] ** 2)
        s = np.minimum(np.maximum(distance - 1.0, 0.0), 1.0)
        return s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s), away / np.maximum(distance, 1e-9)

    def _wall_gap(self, p: FloatArray, rough: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distance to the wall: half the width and its roughness less the distance from the street's middle."""
        rows, columns = self._distance.shape
        place = np.maximum((p[:2] - self._origin) / CELL, 0.0)
        place = np.minimum(place, [[columns - 1.001], [rows - 1.001]])
        whole = place.astype(np.intp)
        u, v = place - whole
        corner = whole[1] * columns + whole[0]
        table = self._distance.ravel()
        d00, d10, d01, d11 = (table.take(corner + step) for step in (0, 1, columns, columns + 1))
        along_x, along_y = d10 - d00, d01 - d00
        twist = d11 - d01 - along_x
        slope[0] -= (along_x + v * twist) / CELL
        slope[1] -= (along_y + u * twist) / CELL
        return self.width / 2.0 + rough - d00 - u * (along_x + v * twist) - v * along_y, slope


def _segment_distance(x: FloatArray, y: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Distance of places from the segment a-b, m."""
    d = b - a
    square = float(d @ d)
    share = np.clip(((x - a[0]) * d[0] + (y - a[1]) * d[1]) / square, 0.0, 1.0) if square else 0.0
    distance: FloatArray = np.hypot(x - a[0] - share * d[0], y - a[1] - share * d[1])
    return distance
