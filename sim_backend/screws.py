"""Screw encoders: the four screws' angles for a wanted body velocity, with slip and noise.

Kinematics of the robot's screws (brief; order front right, rear right, rear left, front left):
vx = r tan(alpha) / 4 (-w1 - w2 + w3 + w4), vy = r / 4 (-w1 + w2 + w3 - w4), wz = -r / (4 c) (w1 + w2 + w3 + w4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]

RADIUS = 0.078
HELIX_ANGLE = float(np.deg2rad(30.0))
HALF_LENGTH, HALF_WIDTH = 0.15, 0.30
TURN_ARM = HALF_LENGTH + HALF_WIDTH / float(np.tan(HELIX_ANGLE))

#: Signs of the four screws in vx, vy, wz and in the fourth combination, which moves nothing on ideal ground.
MODES = np.array([[-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])
#: What one rad/s of each mode's signed sum over four gives: m/s, m/s, rad/s, and rad/s for the fourth mode.
SCALE = np.array([RADIUS * np.tan(HELIX_ANGLE), RADIUS, RADIUS / TURN_ARM, 1.0])


def screw_speeds(velocity: FloatArray, internal: FloatArray | float = 0.0) -> FloatArray:
    """Screw speeds, shape (..., 4), rad/s, that move the body at `velocity`, shape (..., 3), m/s, m/s, rad/s.

    The mode rows are orthogonal and of length two, so the inverse is a transpose: without `internal` it is the
    pseudo-inverse of the three kinematic equations.

    Args:
        velocity: vx, vy, wz in the body's axes.
        internal: speed of the fourth mode, (w1 - w2 + w3 - w4) / 4, rad/s, shape (...).
    """
    velocity = np.asarray(velocity, dtype=np.float64)
    fourth = np.broadcast_to(internal, velocity.shape[:-1])[..., None]
    amplitude = np.concatenate([velocity, fourth], axis=-1) / SCALE
    speeds: FloatArray = amplitude @ MODES
    return speeds


@dataclass(frozen=True, slots=True)
class ScrewSettings:
    """Slip and noise of the screws and their encoders.

    Attributes:
        rate: encoder readings per second, Hz.
        ticks_per_turn: of the encoders.
        slip: smallest and largest share of the screws' motion that the ground does not take, per axis.
        slip_length: distance over which the slip changes, m.
        internal_slip: deviation of the fourth mode as a share of the screws' mean speed.
        noise: of each screw's speed while it turns, one standard deviation per reading, rad/s.
    """

    rate: float = 50.0
    ticks_per_turn: int = 4096
    slip: tuple[float, float] = (0.02, 0.30)
    slip_length: float = 1.0
    internal_slip: float = 0.05
    noise: float = 0.15


class ScrewEncoders:
    """Turns true motion into encoder counts: the screws turn more than the body moves."""

    #: Waves that make up each axis's slip over the ground.
    WAVES = 24
    #: Below this the screws stand still and have no noise, rad/s.
    STANDSTILL = 1e-3

    def __init__(self, seed: int, settings: ScrewSettings | None = None) -> None:
        """Draw the ground's slip."""
        self.settings = settings or ScrewSettings()
        self._rng = stream(seed, "screws")
        wave_rng = stream(seed, "slip")
        # Random waves with Gaussian wave vectors: a Gaussian process of correlation exp(-(d / length)^2 / 2).
        self._waves = wave_rng.normal(0.0, 1.0 / self.settings.slip_length, (4, self.WAVES, 2))
        self._phases = wave_rng.uniform(0.0, 2.0 * np.pi, (4, self.WAVES))
        self.angle = np.zeros(4)

    def slip(self, position: FloatArray) -> FloatArray:
        """Slip of vx, vy, wz at positions of shape (n, 2), m: shares within `settings.slip`, shape (n, 3)."""
        low, high = self.settings.slip
        share: FloatArray = low + (high - low) * 0.5 * (1.0 + np.tanh(self._texture(position)[:, :3]))
        return share

    def advance(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Cumulative screw angles after n intervals of 1 / rate, shape (n, 4), rad.

        Args:
            position: of base_link in the map in each interval, shape (n, 2), m.
            velocity: mean body velocity in each, shape (n, 3), m/s, m/s, rad/s.
        """
        s = self.settings
        wanted = velocity / (1.0 - self.slip(position))
        ideal = screw_speeds(wanted)
        internal = s.internal_slip * np.abs(ideal).mean(axis=1) * self._texture(position)[:, 3]
        speeds = screw_speeds(wanted, internal)
        turning = np.abs(speeds).max(axis=1, keepdims=True) > self.STANDSTILL
        speeds += turning * self._rng.normal(0.0, s.noise, speeds.shape)
        angles: FloatArray = self.angle + (speeds / s.rate).cumsum(axis=0)
        self.angle = angles[-1].copy()
        return angles

    def ticks(self, angle: FloatArray) -> NDArray[np.int64]:
        """Encoder counts for cumulative angles in rad."""
        return np.floor(angle * (self.settings.ticks_per_turn / (2.0 * np.pi))).astype(np.int64)

    def _texture(self, position: FloatArray) -> FloatArray:
        """Four smooth random functions of the place with deviation one, shape (n, 4)."""
        phase = np.einsum("kwd,nd->nkw", self._waves, position) + self._phases
        texture: FloatArray = np.sqrt(2.0 / self.WAVES) * np.cos(phase).sum(axis=-1)
        return texture
