"""Moving, silty water and the mud that lies in hollows: what they are like, and how hard they press on a rod.

The water is deeper than the robot is high and flows level. Its velocity is a mean current with gusts, and eddies that
the current carries along: plane waves across their own wave vector, so that no water is made or lost (Kraichnan,
"Diffusion by a random velocity field", 1970), moved with the mean (Taylor's frozen turbulence, 1938).

The mud is soft against a rod's spring: its yield stress bends a rod by a degree or so, the ground by twenty
times as much. So a tip passes through it and rests on the firm ground below; `World.height` is the firm
ground, and mud is a resistance above it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mud:
    """Fluid mud, a Bingham plastic, with a level top.

    Attributes:
        top: height of its surface, m, in the map frame; it lies wherever the firm ground is lower.
        yield_stress: Pa; fluid mud has 1 to 100 (Berlamont et al., "The characterisation of cohesive sediment
            properties", 1993).
        viscosity: plastic viscosity, Pa s.
        bearing: resistance per length of a rod moved sideways over its diameter and the mud's shear stress; 9.1
            for a smooth rod, 11.9 for a rough one (Randolph and Houlsby, "The limiting pressure on a circular pile
            loaded laterally in cohesive soil", 1984).
        creep: below this speed, m/s, the resistance falls to zero, as a plastic's would not; it keeps it smooth.
    """

    top: float
    yield_stress: float = 20.0
    viscosity: float = 0.1
    bearing: float = 10.5
    creep: float = 0.01

    def resistance(self, speed: FloatArray, diameter: float) -> FloatArray:
        """Force per length over the speed of a rod across itself, N s/m2; the mud's shear rate is speed / diameter."""
        coefficient: FloatArray = self.bearing * (self.yield_stress * diameter / (speed + self.creep) + self.viscosity)
        return coefficient


@dataclass(frozen=True, slots=True)
class Current:
    """Velocity of the water over place and time.

    Attributes:
        seed: draws eddies and gusts.
        speed: of the mean current, m/s: a mountain stream's, and that of a gallery that is being drained.
        direction: that it flows to, from the map's x-axis, rad.
        gusts: greatest change of the mean speed, share.
        gust_periods: of the waves that gusts are made of, s; none divides another.
        eddies: root mean square of the eddies' velocity, m/s.
        eddy_lengths: shortest and longest eddy, m: between a rod's length, which feels smaller ones as noise that
            cancels, and a gallery's width.
        waves: number of waves that eddies are made of.
    """

    seed: int = 0
    speed: float = 0.5
    direction: float = np.deg2rad(150.0)
    gusts: float = 0.2
    gust_periods: tuple[float, ...] = (7.0, 17.0, 41.0)
    eddies: float = 0.1
    eddy_lengths: tuple[float, float] = (0.3, 2.5)
    waves: int = 10
    _table: FloatArray = field(init=False, repr=False, compare=False)
    _gust_phase: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        rng = stream(self.seed, "water")
        shortest, longest = self.eddy_lengths
        number = 2.0 * np.pi / np.exp(rng.uniform(np.log(shortest), np.log(longest), self.waves))
        angle = rng.uniform(0.0, 2.0 * np.pi, self.waves)
        phase = rng.uniform(0.0, 2.0 * np.pi, self.waves)
        wave = number * np.array([np.cos(angle), np.sin(angle)])
        carried = -self.speed * (np.cos(self.direction) * wave[0] + np.sin(self.direction) * wave[1])
        size = self.eddies * np.sqrt(2.0 / max(self.waves, 1))
        object.__setattr__(
            self, "_table", np.stack([*wave, carried, phase, -size * np.sin(angle), size * np.cos(angle)])
        )
        object.__setattr__(self, "_gust_phase", rng.uniform(0.0, 2.0 * np.pi, len(self.gust_periods)))

    def at(self, time: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """Velocity at times (s) and places (m) of equal shape (...), shape (..., 3), m/s, in the map's axes."""
        kx, ky, carried, phase, along_x, along_y = self._table
        wave = np.cos(x[..., None] * kx + y[..., None] * ky + time[..., None] * carried + phase)
        gust = np.sin(2.0 * np.pi * time[..., None] / np.array(self.gust_periods) + self._gust_phase).mean(axis=-1)
        mean = self.speed * (1.0 + self.gusts * gust)
        velocity = np.zeros((*np.shape(x), 3))
        velocity[..., 0] = mean * np.cos(self.direction) + wave @ along_x
        velocity[..., 1] = mean * np.sin(self.direction) + wave @ along_y
        return velocity


@dataclass(frozen=True, slots=True)
class Water:
    """Water with silt in it, and perhaps mud under it.

    Attributes:
        current: how it flows.
        mud: what lies in the hollows.
        density: kg/m3; water with a sixth of its mass silt.
        viscosity: Pa s; a silt suspension has several times that of water.
        added_mass: of a rod, over the mass of the water that it displaces; 1 for a cylinder (Morison et al., "The
            force exerted by surface waves on piles", 1950).
    """

    current: Current = field(default_factory=Current)
    mud: Mud | None = None
    density: float = 1100.0
    viscosity: float = 0.005
    added_mass: float = 1.0

    def resistance(self, speed: FloatArray, diameter: float) -> FloatArray:
        """Drag per length of a cylinder in a flow across it over the speed, N s/m2: rho / 2 D C_d |u|.

        C_d = 1 + 10 Re^(-2/3), for Re from 1 to 2e5 (White, "Viscous Fluid Flow", on cylinders in crossflow).
        """
        slow = 10.0 * (self.viscosity / (self.density * diameter)) ** (2.0 / 3.0)
        coefficient: FloatArray = 0.5 * self.density * diameter * (speed + slow * np.cbrt(speed))
        return coefficient
