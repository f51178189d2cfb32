"""What the simulated robot's sensors deliver, in simulated time.

Times are integer nanoseconds since the start of the simulation: `time_ns` when the measurement began, `ready_ns`
when the device has it and sends it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sim_backend.physics import ArrayReading

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WhiskerEvent:
    """One frame of the array: fields, shape (rows * cols, 3), mT; valid, shape (rows * cols,); the truth or None.

    `contact_point` are the truth's contacts in base_link as it was at each sensor's reading, shape (rows * cols, 3), m.
    """

    time_ns: int
    ready_ns: int
    field_mT: FloatArray
    valid: NDArray[np.bool_]
    truth: ArrayReading | None
    contact_point: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class ImuEvent:
    """Angular rate, rad/s, and specific force, m/s2, shape (3,) each, in base_link's axes.

    `gravity` is the part of the force that gravity makes, in the same axes.
    """

    time_ns: int
    ready_ns: int
    gyro: FloatArray
    acceleration: FloatArray
    gravity: FloatArray


@dataclass(frozen=True, slots=True)
class EncoderEvent:
    """Cumulative counts of the four screws (FR, RR, RL, FL), shape (4,), and the angles they stand for, rad."""

    time_ns: int
    ready_ns: int
    ticks: NDArray[np.int64]
    angle: FloatArray


@dataclass(frozen=True, slots=True)
class OdometryEvent:
    """Ready-made odometry: vx, vy, wz, shape (3,), mean over the interval that ends at `time_ns`."""

    time_ns: int
    ready_ns: int
    velocity: FloatArray


@dataclass(frozen=True, slots=True)
class TruthEvent:
    """Where base_link really is in the map: position (m), quaternion x y z w; velocities in its own axes."""

    time_ns: int
    ready_ns: int
    position: FloatArray
    orientation_xyzw: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray


Event: TypeAlias = WhiskerEvent | ImuEvent | EncoderEvent | OdometryEvent | TruthEvent
