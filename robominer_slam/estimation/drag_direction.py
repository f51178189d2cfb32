"""Whiskers trail behind the motion: what their directions say about the body's velocity.

A dragged tip on the ground moves along its rod's horizontal direction, towards the mount (a tractrix). With p the
tip in base_link, d the unit vector from base to tip in the horizontal plane, n perpendicular to d, and p' the tip's
motion within base_link:

    n . (v + wz (-p_y, p_x) + p') = 0.

In steady motion p' is zero and the tip trails against its motion; after starts, reversals and turns p' is what still
turns the rod, so nothing has to be waited for. Slopes turn tips sideways: one whisker's error lasts some centimetres
of the way, so a frame counts only by the way made since the last one.

The measurement is linearised at the estimated velocity: n is replaced by the perpendicular of the predicted motion of
the tip. With the measured n, noise in n would pass for knowledge that the speed is small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts
from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]

#: Frames back to which a rod's turning is looked at: fewer make it noisy, more make it late.
WINDOW = 3
#: Longer ago than this, s, a tip's place says nothing about its motion.
MAX_AGE_S = 0.3
#: Fewer tips than this say nothing.
LEAST_TIPS = 4


@dataclass(frozen=True, slots=True)
class DragInformation:
    """What a frame's tips say about (vx, vy, wz), in information form around the estimate they were judged with.

    Attributes:
        information: shape (3, 3); singular along the motion itself, of which the tips say nothing.
        vector: information times the correction of the velocity, shape (3,).
        tips: how many counted.
    """

    information: FloatArray
    vector: FloatArray
    tips: int

    def compressed(self) -> tuple[FloatArray, FloatArray]:
        """Rows H (k, 3) and innovations (k,) with unit covariance that say the same; k of 0 to 3."""
        values, vectors = np.linalg.eigh(self.information)
        kept = values > 1e-9 * max(float(values[-1]), 1e-9)
        root = np.sqrt(values[kept])
        H = root[:, None] * vectors[:, kept].T
        return H, (vectors[:, kept].T @ self.vector) / root


class DragDirection:
    """Keeps the tips of the last frames and turns a frame into information."""

    def __init__(self, settings: RobustEstimationSection, layout: WhiskerLayout) -> None:
        """Only whiskers that point down count; the others are for walls."""
        self._settings = settings
        self._layout = layout
        downward = -layout.R_base_whisker[:, 2, 2]
        self._floor = downward >= math.cos(math.radians(settings.drag_mount_tilt_deg))
        self._sigma2 = math.radians(settings.drag_sigma_deg) ** 2
        self._history: list[tuple[int, FloatArray]] = []
        self._last_ns: int | None = None

    def reach(self, contacts: Contacts) -> FloatArray:
        """Horizontal vectors from base to tip, shape (m, 2), m, in base_link."""
        sine = np.sin(contacts.inclination)
        direction = np.stack(
            [sine * np.cos(contacts.azimuth), sine * np.sin(contacts.azimuth), np.cos(contacts.inclination)], axis=1
        )
        R = self._layout.R_base_whisker[contacts.index, :2]
        rod: FloatArray = np.matmul(R, direction[:, :, None])[:, :, 0]
        return rod * self._layout.length[contacts.index, None]

    def measure(self, stamp_ns: int, contacts: Contacts, velocity: FloatArray) -> DragInformation | None:
        """Take a frame.

        Args:
            stamp_ns: of the frame.
            contacts: in base_link.
            velocity: estimated vx, vy (m/s), wz (rad/s), shape (3,).

        Returns:
            None where too few tips move.
        """
        settings = self._settings
        index = contacts.index
        rod = self.reach(contacts)
        tips = np.full((self._layout.count, 2), np.nan)
        tips[index] = rod
        old = self._remember(stamp_ns, tips)
        last, self._last_ns = self._last_ns, stamp_ns
        if old is None or last is None or len(index) < LEAST_TIPS:
            return None
        span, before = old
        turning = (rod - before[index]) / span
        p = self._layout.p_base[index, :2] + rod
        moving = np.empty_like(p)
        moving[:, 0] = velocity[0] - velocity[2] * p[:, 1]
        moving[:, 1] = velocity[1] + velocity[2] * p[:, 0]
        swept = moving + turning
        speed = np.sqrt(swept[:, 0] ** 2 + swept[:, 1] ** 2)
        length = np.sqrt(rod[:, 0] ** 2 + rod[:, 1] ** 2)
        ok = (
            self._floor[index]
            & (contacts.inclination > math.radians(settings.drag_min_inclination_deg))
            & (speed > settings.drag_least_speed)
        )
        ok &= (rod * swept).sum(axis=1) < -0.7 * length * speed
        if np.count_nonzero(ok) < LEAST_TIPS:
            return None
        p, swept, speed = p[ok], swept[ok], speed[ok]
        d = rod[ok] / length[ok, None]
        # Sideways motion that the rod's direction denies, n . (v + wz x p + p'), with n to the left of the motion.
        residual = -(d[:, 0] * swept[:, 1] - d[:, 1] * swept[:, 0])
        m = np.stack([-swept[:, 1], swept[:, 0]], axis=1) / speed[:, None]
        rows = np.column_stack([m, m[:, 1] * p[:, 0] - m[:, 0] * p[:, 1]])
        angle = residual / speed
        way = float(np.mean(speed)) * (stamp_ns - last) * 1e-9
        discount = min(1.0, way / (2.0 * settings.drag_length))
        weight = discount / (self._sigma2 * speed**2)
        # Student's t with four degrees of freedom: a tip on a steep side counts little.
        weight *= 5.0 / (4.0 + angle**2 / self._sigma2)
        weighted = rows * weight[:, None]
        return DragInformation(weighted.T @ rows, -(weighted.T @ residual), int(ok.sum()))

    def _remember(self, stamp_ns: int, tips: FloatArray) -> tuple[float, FloatArray] | None:
        history = self._history
        history.append((stamp_ns, tips))
        if len(history) > WINDOW + 1:
            history.pop(0)
        while len(history) > 1 and stamp_ns - history[0][0] > MAX_AGE_S * 1e9:
            history.pop(0)
        if len(history) < 2:
            return None
        return (stamp_ns - history[0][0]) * 1e-9, history[0][1]
