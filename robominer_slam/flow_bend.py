"""Tells free whiskers that flowing water bends from whiskers that touch, where the array as a whole shows it.

Water bends all free rods alike: by an angle that gusts and eddies change little across the array, in a direction that
has nothing to do with the robot's motion. Ground bends each rod by its own height, against the motion. So slightly
bent rods that agree in both are free. Where the common bend is against the motion, dragged tips on level ground would
look the same; then it counts as flow only if it is what the flow was before, in odom's axes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.model import ContactSection
from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: A common bend closer than this to the direction against the motion may be that of dragged tips.
COSINE_TRAILING = math.cos(math.radians(40.0))
#: A robot that is slower drags nothing, m/s.
STANDSTILL = 0.02
#: Time over which the flow is remembered, s: gusts take several.
MEMORY_S = 3.0
#: Share of the slightly bent rods that must agree: fewer are a coincidence.
AGREEING = 0.4


class FlowBend:
    """Finds the bend that free rods have in common, frame by frame.

    Attributes:
        bend: of the last frame in base_link's x and y, shape (2,), rad; None where none was found.
    """

    def __init__(self, settings: ContactSection, layout: WhiskerLayout) -> None:
        """Nothing is known of the flow yet."""
        self._settings = settings
        self._x_axis = np.ascontiguousarray(layout.R_base_whisker[:, :2, 0].T)
        self._y_axis = np.ascontiguousarray(layout.R_base_whisker[:, :2, 1].T)
        self._remembered: FloatArray | None = None
        self._remembered_ns = 0
        self.bend: FloatArray | None = None

    def free(
        self,
        stamp_ns: int,
        inclination: FloatArray,
        azimuth: FloatArray,
        valid: BoolArray,
        heading: float,
        velocity: FloatArray,
    ) -> BoolArray | None:
        """Whiskers that only the flow bends, shape (n,); None where no flow shows.

        Args:
            stamp_ns: of the frame.
            inclination, azimuth: shape (n,), rad.
            valid: whose angles may be used, shape (n,).
            heading: of base_link in odom, rad.
            velocity: of the body, vx and vy first, m/s.
        """
        settings = self._settings
        self.bend = None
        slight = valid & (inclination < math.radians(settings.flow_bend_deg))
        if np.count_nonzero(slight) < settings.flow_whiskers:
            return None
        who = np.flatnonzero(slight)
        phi, a = inclination[who], azimuth[who]
        tilt = self._x_axis[:, who] * (phi * np.cos(a)) + self._y_axis[:, who] * (phi * np.sin(a))
        spread = math.radians(settings.flow_spread_deg)
        bend = self._common(tilt, spread)
        if bend is None or not self._is_flow(stamp_ns, bend, heading, velocity, spread):
            return None
        self.bend = bend
        agrees = np.zeros(len(valid), dtype=np.bool_)
        agrees[who] = np.hypot(tilt[0] - bend[0], tilt[1] - bend[1]) < spread
        return agrees

    def _common(self, tilt: FloatArray, spread: float) -> FloatArray | None:
        """Where most of the tilts, shape (2, m), lie together; None if too few do."""
        off = tilt[:, :, None] - tilt[:, None, :]
        close = np.add.reduce(off * off) < spread * spread
        best = close[np.add.reduce(close, axis=1, dtype=np.intp).argmax()]
        bend: FloatArray = tilt[:, best].mean(axis=1)
        off = tilt - bend[:, None]
        count = np.count_nonzero(np.add.reduce(off * off) < spread * spread)
        enough = count >= self._settings.flow_whiskers and count >= AGREEING * tilt.shape[1]
        return bend if enough else None

    def _is_flow(self, stamp_ns: int, bend: FloatArray, heading: float, velocity: FloatArray, spread: float) -> bool:
        c, s = math.cos(heading), math.sin(heading)
        x, y = float(bend[0]), float(bend[1])
        in_odom = np.array([c * x - s * y, s * x + c * y])
        speed = math.hypot(velocity[0], velocity[1])
        against = -(x * velocity[0] + y * velocity[1])
        trailing = speed > STANDSTILL and against > COSINE_TRAILING * speed * math.hypot(x, y)
        if trailing:
            known = self._remembered
            if known is None or math.dist(known, in_odom) > spread:
                return False
        share = 1.0
        if self._remembered is not None:
            share = 1.0 - math.exp(-min((stamp_ns - self._remembered_ns) * 1e-9, 60.0) / MEMORY_S)
            in_odom = self._remembered + share * (in_odom - self._remembered)
        self._remembered, self._remembered_ns = in_odom, stamp_ns
        return True
