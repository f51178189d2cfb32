"""Whisker angles to contact points in base_link.

Tip = base + R_mount L (sin phi cos a, sin phi sin a, cos phi); the contact point is taken to be the tip (the
thesis's tip assumption, section 3.1). A whisker that hangs at rest touches nothing and gives none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Contacts:
    """Contact points of one frame, shape (m, 3) in base_link, m; whose they are, and at what angles (rad)."""

    points: FloatArray
    index: NDArray[np.intp]
    inclination: FloatArray
    azimuth: FloatArray


def at_frame_start(contacts: Contacts, velocity: FloatArray, sensor_period_ns: int) -> Contacts:
    """The contacts in base_link as it stood when the frame's first sensor was read.

    Sensors are read one after the other, and the body moves meanwhile: 6 mm over a frame of 38 ms at 0.15 m/s. To the
    first order, p(t_0) = p(t_k) + (t_k - t_0) (v + omega x p).

    Args:
        contacts: each in base_link at its own sensor's reading.
        velocity: of the body: vx, vy (m/s), wz (rad/s), shape (3,).
        sensor_period_ns: from one sensor's reading to the next, row-major.
    """
    if not sensor_period_ns or not len(contacts.index):
        return contacts
    later = contacts.index * (sensor_period_ns * 1e-9)
    points = contacts.points.copy()
    points[:, 0] += later * (velocity[0] - velocity[2] * contacts.points[:, 1])
    points[:, 1] += later * (velocity[1] + velocity[2] * contacts.points[:, 0])
    return replace(contacts, points=points)


class ContactModel:
    """Decides who touches, and computes where.

    Args:
        layout: the array.
        min_inclination: below it a whisker counts as free, rad.
        max_inclination: above it the tip assumption fails, rad.
    """

    def __init__(self, layout: WhiskerLayout, min_inclination: float, max_inclination: float) -> None:
        self._layout = layout
        self._min = min_inclination
        self._max = max_inclination

    def tips(self, inclination: FloatArray, azimuth: FloatArray) -> FloatArray:
        """Tips of all whiskers in base_link, shape (n, 3), m, from angles of shape (n,), rad."""
        sine = np.sin(inclination)
        direction = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(inclination)], axis=1)
        layout = self._layout
        rod = np.matmul(layout.R_base_whisker, direction[:, :, None])[:, :, 0]
        tips: FloatArray = layout.p_base + layout.length[:, None] * rod
        return tips

    def contacts(self, inclination: FloatArray, azimuth: FloatArray, valid: NDArray[np.bool_]) -> Contacts:
        """Contact points of a frame; arrays of shape (n,), `valid` False for whiskers that say nothing."""
        touching = valid & self._layout.present & (inclination >= self._min) & (inclination <= self._max)
        index = np.flatnonzero(touching)
        return Contacts(self.tips(inclination, azimuth)[index], index, inclination[index], azimuth[index])
