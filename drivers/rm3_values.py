"""What the values of the RM3 whisker firmware mean, however they were printed.

Spherical: azimuth atan2(By, Bx) and polar atan2(Bz, hypot(Bx, By)) in degrees, magnitude in mT or left out. The
firmware has no word for an error: a sensor that does not answer is all zeros.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from drivers.measurement import BoolArray, FloatArray
from drivers.readings import HallReading

Representation: TypeAlias = Literal["cartesian", "spherical", "spherical-magnitude"]

#: TLV493D: 12 bits signed at 0.098 mT (data sheet, table 1: magnetic characteristics), with a little margin.
LARGEST_MT = 205.0
LARGEST_MAGNITUDE_MT = LARGEST_MT * 3.0**0.5
#: Largest absolute value of each component, with a hundredth for rounding.
LIMITS_CARTESIAN = np.full(3, LARGEST_MT)
LIMITS_SPHERICAL = np.array([180.01, 90.01, LARGEST_MAGNITUDE_MT])


def values_per_sensor(representation: Representation) -> tuple[int, ...]:
    """How many values the firmware may send for a sensor, the likeliest first."""
    return (2, 3) if representation == "spherical" else (3,)


def hall_reading(values: FloatArray, representation: Representation) -> tuple[HallReading, int]:
    """A frame from its values.

    Args:
        values: shape (rows, cols, 2 or 3), mT or degrees; not finite where the firmware printed no number.
        representation: of the values.

    Returns:
        The reading, with sensors invalid that are all zeros, not finite or beyond what a sensor can give, and how
        many there were of the last. Without a magnitude the third component is zero.
    """
    count = values.shape[2]
    limits = LIMITS_CARTESIAN if representation == "cartesian" else LIMITS_SPHERICAL
    within: BoolArray = np.logical_and.reduce(np.abs(values) <= limits[:count], axis=2)
    valid: BoolArray = within & np.logical_or.reduce(values != 0.0, axis=2)
    if count == 2:
        padded = np.zeros((*values.shape[:2], 3))
        padded[..., :2] = values
        values = padded
    out_of_range = 0
    if not within.all():
        out_of_range = int(np.count_nonzero(~within & np.isfinite(values).all(axis=2)))
        values = np.where(within[..., None], values, 0.0)
    name = "Cartesian" if representation == "cartesian" else "Spherical"
    return HallReading(None, None, values, valid, 0, name), out_of_range
