"""Timed measurements: what every driver, recording and remote source delivers.

Times are integer nanoseconds of the host's monotonic clock (live) or of the recording's clock (replay), and
stand for the start of the measurement. Arrays are never modified after construction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]

#: Names of the screws in this program's order; RM3's motor modules are numbered in the same order.
SCREW_NAMES = ("front_right", "rear_right", "rear_left", "front_left")


@dataclass(frozen=True, slots=True)
class HallFrame:
    """One reading of the whole whisker array.

    Attributes:
        stamp_ns: time of the first sensor's reading.
        field_mT: magnetic field, shape (rows, cols, 3), mT; rows of invalid sensors hold zeros.
        valid: shape (rows, cols); False where the device reported no reading.
        sensor_period_ns: time from one sensor's reading to the next, row-major, invalid ones included.
        representation: `Cartesian` (Bx, By, Bz in mT); `Spherical` (azimuth deg, polar deg, magnitude mT; a magnitude
            of zero was not sent); `Direction` (unit vectors: what `spherical.cartesian_frame` makes of those).
    """

    stamp_ns: int
    field_mT: FloatArray
    valid: BoolArray
    sensor_period_ns: int = 0
    representation: str = "Cartesian"


@dataclass(frozen=True, slots=True)
class ImuSample:
    """Angular rate and specific force in the IMU's own frame.

    Attributes:
        stamp_ns: time of the sample.
        gyro: shape (3,), rad/s; None where the device has no gyro.
        acceleration: shape (3,), m/s2, specific force (+9.81 on z at rest) unless configured gravity-free.
        orientation_xyzw: quaternion of the IMU in its own reference frame, or None.
    """

    stamp_ns: int
    gyro: FloatArray | None
    acceleration: FloatArray | None
    orientation_xyzw: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class ScrewAngles:
    """Cumulative angles of the four screws (FR, RR, RL, FL), shape (4,), rad, unwrapped."""

    stamp_ns: int
    angle: FloatArray


@dataclass(frozen=True, slots=True)
class ScrewSpeeds:
    """Speeds of some or all screws, rad/s; shape (4,) with NaN where this message says nothing."""

    stamp_ns: int
    speed: FloatArray
    current_mA: FloatArray | None = None
    voltage_V: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class OdometrySample:
    """A ready-made odometry: body velocity (vx, vy, wz), mean over the interval that ends at the stamp."""

    stamp_ns: int
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))


Measurement: TypeAlias = HallFrame | ImuSample | ScrewAngles | ScrewSpeeds | OdometrySample
