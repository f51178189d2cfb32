"""What water and mud do to whiskers: drag summed along the rods, buoyancy, damping, for both engines.

Each piece of a rod is dragged by what moves across it, the crossflow principle (Hoerner, "Fluid-Dynamic Drag", 1965):
f = g(|w|) w per length, with w the part across the rod of the water's velocity less the piece's own (Morison's drag
term). About the joint, f at the distance s counts s f. In mud, the water does not flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.water import Water
from sim_backend.whisker_model import WhiskerMechanics

FloatArray = NDArray[np.float64]

#: Pieces of equal length that a rod is looked at in: 3 cm each, s^2 comes out within 1 %.
PIECES = 5
GRAVITY = 9.81


@dataclass(frozen=True, slots=True)
class RodLoad:
    """Load on n rods, at any number of instants.

    Attributes:
        pull: sum over the rod of distance from the joint times force, shape (..., n, 3), N m, map axes; its moment
            is rod direction x pull.
        damping: what the load loses per rad/s by which the rod gives way, shape (..., n), N m s/rad.
    """

    pull: FloatArray
    damping: FloatArray


class RodDrag:
    """Sums the load of water and mud along the rods of an array."""

    def __init__(self, water: Water, length: FloatArray, radius: float) -> None:
        """Rods of these lengths, shape (n,), m, and this radius, m."""
        self.water = water
        self._diameter = 2.0 * radius
        self._piece = length / PIECES
        self._s = (np.arange(PIECES)[:, None] + 0.5) * self._piece
        displaced = water.density * np.pi * radius**2 * length
        self._buoyancy = displaced * GRAVITY * length / 2.0
        #: Moment of inertia of the water that moves along, shape (n,), kg m2.
        self.added_inertia = water.added_mass * displaced * length**2 / 3.0

    def load(
        self,
        time: FloatArray,
        mount: FloatArray,
        velocity: FloatArray,
        omega: FloatArray,
        direction: FloatArray,
        swing: FloatArray | None = None,
    ) -> RodLoad:
        """Load on the rods.

        Args:
            time: shape (..., n), s.
            mount, velocity: of the joints, shape (..., n, 3), m and m/s, in the map.
            omega: of the body, shape (..., n, 3) or (..., 1, 3), rad/s, map axes.
            direction: of the rods, shape (..., n, 3), map axes.
            swing: change of the direction by the hinges, shape (..., n, 3), 1/s; it counts in the size of the drag
                and is left out of `pull`: `damping` is its part.
        """
        middle = mount + (self._s[PIECES // 2])[:, None] * direction
        current = self.water.current.at(time, middle[..., 0], middle[..., 1])
        s = self._s.reshape(PIECES, *(1,) * (direction.ndim - 2), -1)
        turning = np.cross(omega, direction)
        in_mud = self._in_mud(mount[..., 2] + s * direction[..., 2], direction[..., 2])
        past = (1.0 - in_mud)[..., None] * current - velocity - s[..., None] * turning
        moving = past if swing is None else past - s[..., None] * swing
        along = (moving * direction).sum(axis=-1)
        speed = np.sqrt(np.maximum(np.square(moving).sum(axis=-1) - along**2, 0.0))
        g = (1.0 - in_mud) * self.water.resistance(speed, self._diameter)
        if self.water.mud is not None:
            g += in_mud * self.water.mud.resistance(speed, self._diameter)
        lever = s * g * self._piece
        pull = (lever[..., None] * past).sum(axis=0)
        pull -= (pull * direction).sum(axis=-1, keepdims=True) * direction
        pull[..., 2] += self._buoyancy
        return RodLoad(pull, (s * lever).sum(axis=0))

    def _in_mud(self, height: FloatArray, upward: FloatArray) -> FloatArray:
        """Share of each piece that is in mud, for heights of their middles, shape (pieces, ..., n), m."""
        if self.water.mud is None:
            return np.zeros_like(height)
        tall = self._piece * np.maximum(np.abs(upward), 0.1)
        share: FloatArray = np.clip((self.water.mud.top - height) / tall + 0.5, 0.0, 1.0)
        return share

    def on_hinges(
        self,
        time: float,
        mount: FloatArray,
        R_map_whisker: FloatArray,
        velocity: FloatArray,
        hinge: FloatArray,
        rate: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Torque on the hinges without its damping, shape (n, 2), N m, and that damping, shape (n, 2), N m s/rad.

        Args:
            time: s.
            mount: shape (n, 3), m, in the map.
            R_map_whisker: shape (n, 3, 3).
            velocity: of the mounts in map axes and angular in the whiskers', shape (n, 6), m/s, rad/s.
            hinge, rate: of both hinges, shape (n, 2), rad, rad/s.
        """
        cos, sin = np.cos(hinge), np.sin(hinge)
        x, y, z = R_map_whisker[..., 0], R_map_whisker[..., 1], R_map_whisker[..., 2]
        second = cos[:, :1] * y + sin[:, :1] * z  # axis of the second hinge; the first one's is x
        d = sin[:, 1:] * x + cos[:, 1:] * (cos[:, :1] * z - sin[:, :1] * y)
        swing = np.cross(rate[:, :1] * x + rate[:, 1:] * second, d)
        omega = np.einsum("nij,nj->ni", R_map_whisker, velocity[:, 3:])
        load = self.load(np.full(len(hinge), time), mount, velocity[:, :3], omega, d, swing)
        moment = np.cross(d, load.pull)
        torque = np.stack([(moment * x).sum(axis=-1), (moment * second).sum(axis=-1)], axis=-1)
        # The rod's end moves by cos(q1) per angle of the first hinge, and the two hinges move it at right angles.
        damping = np.stack([load.damping * cos[:, 1] ** 2, load.damping], axis=-1)
        return torque, damping


class BentRods:
    """Water for rods without inertia: where free ones hang, and what pushes touching ones; over stiffness."""

    def __init__(self, water: Water, length: FloatArray, mechanics: WhiskerMechanics, interval: float) -> None:
        """Rods of these lengths, shape (n,), m, looked at every `interval` seconds."""
        self._drag = RodDrag(water, length, mechanics.radius)
        self._stiffness, self._interval = mechanics.stiffness, interval
        self._dry = np.array([mechanics.damping(each) for each in length])
        self._pull = np.zeros((len(length), 3))
        self._block: tuple[FloatArray, FloatArray, FloatArray, FloatArray]

    def hang(
        self, time: FloatArray, mount: FloatArray, velocity: FloatArray, omega: FloatArray, rest: FloatArray
    ) -> FloatArray:
        """Pull on free rods over stiffness in a block of frames, shape (frames, n, 3), rad.

        It follows the load with the time constant of the damped joint, (dry damping + water's) / stiffness.

        Args:
            time: of the readings, shape (frames, n), s.
            mount, velocity: of the joints, shape (frames, n, 3), m, m/s.
            omega: of the body, shape (frames, 3), rad/s.
            rest: directions of the rods without water, shape (frames, n, 3).
        """
        self._block = (time, mount, velocity, omega[:, None])
        load = self._drag.load(*self._block, rest)
        target = load.pull / self._stiffness
        share = 1.0 - np.exp(-self._interval * self._stiffness / (self._dry + load.damping))
        for k in range(len(target)):
            self._pull = self._pull + share[k][:, None] * (target[k] - self._pull)
            target[k] = self._pull
        return target

    def push(self, frame: int, direction: FloatArray) -> FloatArray:
        """Pull on rods in direction (3, n) over stiffness, shape (3, n), rad, in a frame of the last block.

        The end of a dragged rod moves with its mount.
        """
        time, mount, velocity, omega = self._block
        load = self._drag.load(time[frame], mount[frame], velocity[frame], omega[frame], direction.T)
        push: FloatArray = load.pull.T / self._stiffness
        return push
