"""Slow changes of the Hall readings: temperature takes strength from the magnets, rest readings wander."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DriftSettings:
    """How much and how fast.

    Attributes:
        temperature: deviation of the array's temperature from that of its calibration, K.
        temperature_time: correlation time of the temperature, s: electronics and rock warm up in minutes.
        strength_per_kelvin: of the magnets' field (sintered NdFeB loses 0.11 % a kelvin).
        offset_walk: random walk of each sensor's offset, mT per square root of a second: the membranes creep; 0.3 mT,
            one degree, in an hour.
    """

    temperature: float = 3.0
    temperature_time: float = 600.0
    strength_per_kelvin: float = -0.0011
    offset_walk: float = 0.005


class HallDrift:
    """Drift of the fields of n sensors; starts where the calibration was made."""

    def __init__(self, seed: int, count: int, settings: DriftSettings | None = None) -> None:
        """Start without any drift."""
        self.settings = settings or DriftSettings()
        self._rng = stream(seed, "hall drift")
        self._offset = np.zeros((count, 3))
        self._temperature = 0.0

    def apply(self, field_mT: FloatArray, interval: float) -> FloatArray:
        """Fields as the drifted sensors see them.

        Args:
            field_mT: one frame, shape (n, 3), or several in a row, shape (m, n, 3), mT.
            interval: time from frame to frame, and from the last call's last frame to the first of these, s.
        """
        s = self.settings
        frames = field_mT.reshape(-1, *self._offset.shape)
        # The same draws whether frames come one by one or together.
        drawn = self._rng.normal(0.0, 1.0, (len(frames), 1 + self._offset.size))
        # Ornstein-Uhlenbeck: wanders, but stays within a few kelvins.
        keep = np.exp(-interval / s.temperature_time)
        temperature = np.empty(len(frames))
        for k, step in enumerate(drawn[:, 0] * (s.temperature * np.sqrt(1.0 - keep**2))):
            self._temperature = keep * self._temperature + step
            temperature[k] = self._temperature
        steps = drawn[:, 1:].reshape(frames.shape) * (s.offset_walk * np.sqrt(interval))
        steps[0] += self._offset
        offset = steps.cumsum(axis=0)
        self._offset = offset[-1]
        drifted: FloatArray = frames * (1.0 + s.strength_per_kelvin * temperature)[:, None, None] + offset
        return drifted.reshape(field_mT.shape)
