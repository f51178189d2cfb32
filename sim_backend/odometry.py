"""The thesis's ready-made odometry: true body velocity plus noise whose mean is not zero (section 3.4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.base_motion import BaseStates
from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]

#: Rate for which the thesis's deviations are meant; they are per sample, so that at a rate f they are
#: sigma * sqrt(f / 30 Hz).
REFERENCE_RATE = 30.0


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """Noise of the odometry; the thesis gives no values, these are the project's.

    Attributes:
        rate: samples per second, Hz.
        bias_range: smallest and largest size of the mean on each axis, m/s, m/s, rad/s; the sign is drawn too.
        deviation: of vx, vy, wz per sample at 30 Hz, m/s, m/s, rad/s.
    """

    rate: float = 30.0
    bias_range: tuple[float, float] = (0.001, 0.005)
    deviation: tuple[float, float, float] = (0.05, 0.05, 0.05)


#: Grades by name: half and double the thesis's.
GRADES = {
    "thesis": OdometrySettings(),
    "half": OdometrySettings(bias_range=(0.0005, 0.0025), deviation=(0.025, 0.025, 0.025)),
    "double": OdometrySettings(bias_range=(0.002, 0.010), deviation=(0.1, 0.1, 0.1)),
}


class BiasedOdometry:
    """Draws its biases once from the seed, then turns true motion into body velocities, in order."""

    def __init__(self, seed: int, settings: OdometrySettings | None = None) -> None:
        """Draw the biases."""
        self.settings = settings or OdometrySettings()
        self._rng = stream(seed, "odometry")
        size = self._rng.uniform(*self.settings.bias_range, 3)
        self.bias: FloatArray = size * self._rng.choice([-1.0, 1.0], 3)
        self._deviation = np.array(self.settings.deviation) * np.sqrt(self.settings.rate / REFERENCE_RATE)

    def sample(self, motion: BaseStates) -> FloatArray:
        """Body velocities vx, vy, wz over the n intervals between n + 1 instants, shape (n, 3), m/s, m/s, rad/s."""
        velocity = mean_body_velocity(motion, 1.0 / self.settings.rate)
        noise: FloatArray = self.bias + self._rng.normal(0.0, 1.0, velocity.shape) * self._deviation
        return velocity + noise


def mean_body_velocity(motion: BaseStates, interval: float) -> FloatArray:
    """The constant planar body velocity that leads from each of n + 1 poses to the next, shape (n, 3).

    It is the logarithm of the relative pose over the interval, so that integrating it in its own heading, as
    odometry is integrated, gives the true path: v_body = R(theta)^T v_world set right (the thesis prints both
    rotations transposed).
    """
    heading = np.unwrap(np.arctan2(motion.R[:, 1, 0], motion.R[:, 0, 0]))
    turn = np.diff(heading)
    step = np.diff(motion.position[:, :2], axis=0)
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    local = np.column_stack([c * step[:, 0] + s * step[:, 1], -s * step[:, 0] + c * step[:, 1]])
    # SE(2) logarithm: V(turn)^-1 = [[a, b], [-b, a]] with b = turn / 2, a = b / tan(b).
    b = 0.5 * turn
    a = np.where(np.abs(b) < 1e-6, 1.0 - b**2 / 3.0, b / np.tan(np.where(np.abs(b) < 1e-6, 1.0, b)))
    along = np.column_stack([a * local[:, 0] + b * local[:, 1], -b * local[:, 0] + a * local[:, 1], turn])
    return along / interval
