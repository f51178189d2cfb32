"""Whisker angles to contact points in base_link.

Tip = base + R_mount L (sin phi cos a, sin phi sin a, cos phi); the contact point is taken to be the tip (the
thesis's tip assumption, section 3.1). A whisker that hangs at rest touches nothing and gives none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import WhiskerAngles
from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Contacts:
    """Contact points of one frame, shape (m, 3) in base_link, m; whose they are, and at what angles (rad).

    rod: from base to tip, in base_link as it stood at the sensor's reading, shape (3, m), m.
    """

    points: FloatArray
    index: NDArray[np.intp]
    inclination: FloatArray
    azimuth: FloatArray
    rod: FloatArray


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
    vx, vy, wz = velocity.tolist()
    points[:, 0] += later * (vx - wz * contacts.points[:, 1])
    points[:, 1] += later * (vy + wz * contacts.points[:, 0])
    return Contacts(points, contacts.index, contacts.inclination, contacts.azimuth, contacts.rod)


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
        # Axes of the mounts times the rods' lengths, shape (3 axes, 3, n): numpy goes along whiskers fastest.
        self._reach = np.ascontiguousarray((layout.length[:, None, None] * layout.R_base_whisker).transpose(2, 1, 0))
        self._p_base = np.ascontiguousarray(layout.p_base.T)

    def contacts(self, angles: WhiskerAngles, may_touch: NDArray[np.bool_]) -> Contacts:
        """Contact points of a frame; `may_touch` is False for whiskers that say nothing, shape (n,)."""
        inclination = angles.inclination
        touching = may_touch & self._layout.present & (inclination >= self._min) & (inclination <= self._max)
        (index,) = touching.nonzero()
        rod = np.einsum("ikn,in->kn", self._reach, angles.direction).take(index, axis=1)
        points = np.ascontiguousarray((self._p_base.take(index, axis=1) + rod).T)
        return Contacts(points, index, inclination[index], angles.azimuth[index], rod)
