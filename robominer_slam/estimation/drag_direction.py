"""Whiskers trail behind the motion: what their directions say about the body's velocity.

A dragged tip moves along its rod's horizontal direction, towards the mount (a tractrix). With p the tip in base_link,
d the unit vector from tip to base in the horizontal plane, n perpendicular to d, and p' the tip's motion within
base_link:

    n . (v + wz (-p_y, p_x) + p') = 0.

In steady motion p' is zero; after starts, reversals and turns it is what still turns the rod, so that nothing has to
be waited for. Where the ground falls to one side, the spring pushes the tip down that side until friction holds it:
the rod is turned by `slide` times the cross slope, where `slide` is near 1 / mu + cot(inclination) for a joint of the
same stiffness in all directions. It depends on the ground and is estimated along the way from how the tips of a
frame differ.

What is left is no white noise: tips keep their errors for some centimetres (so a measurement is made once per
`drag_spacing` of the way and counts by the way made), and the array as a whole errs too, the more the stronger it
turns, because a rod's joint may be stiffer across than along. Measured on simulated drives; the numbers are in the
configuration section `robust_estimation`.

The measurement is an angle, so it says nothing of the speed. It must be linearised at a direction of motion that shares
no noise with it: at the prediction, at what the measurement leads to, or with the measured n, the products of noise
with itself pump the speed up or down, measurement by measurement. So it is linearised at the direction that the
measurements before it showed, averaged over the way.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts
from robominer_slam.estimation.cross_slope import CrossSlope
from robominer_slam.estimation.drag_information import DragInformation, FrameInformation, TrailingTips, swept_by
from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]

#: Frames back to which a rod's turning is looked at: fewer make it noisy, more make it late.
WINDOW = 3
#: Longer ago than this, s, a tip's place says nothing about its motion.
MAX_AGE_S = 0.3
#: Fewer tips than this say nothing.
LEAST_TIPS = 6
#: A rod farther from its predicted direction than this (cosine) does not trail: it is held, or pushed.
TRAILING = 0.6
#: Steepest cross slope that is made up for: beyond, tips slip.
STEEPEST = 0.4
#: Cross slope at which a tip's deviation has grown by the square root of two.
DOUBTFUL_SLOPE = 0.15
#: Lever of the array, m, by which turning spreads the directions of its tips.
ARM = 0.25
#: Makes vx, vy, wz alike: m/s each.
METRIC = np.array([1.0, 1.0, ARM])
#: A prediction farther (cosine) from the direction that was shown before means a new way.
SAME_DIRECTION = 0.9
#: Way over which the shown direction is averaged, m.
SHOWN_LENGTH = 1.0
EYE = np.eye(3)


class DragDirection:
    """Keeps the contacts of the last frames; turns a frame into information now and then.

    Args:
        settings: noise and limits, with units and reasons there.
        layout: the array; only whiskers that point down count, the others are for walls.
    """

    def __init__(self, settings: RobustEstimationSection, layout: WhiskerLayout) -> None:
        self._settings = settings
        self._layout = layout
        self._floor = -layout.R_base_whisker[:, 2, 2] >= math.cos(math.radians(settings.drag_mount_tilt_deg))
        self._least_inclination = math.radians(settings.drag_min_inclination_deg)
        self._sigma2 = math.radians(settings.drag_sigma_deg) ** 2
        self._slopes = CrossSlope(layout, self._floor)
        self._p_base = np.ascontiguousarray(layout.p_base[:, :2].T)
        self._frames: deque[tuple[int, Contacts]] = deque(maxlen=WINDOW + 1)
        self._way = 0.0
        self._last_ns: int | None = None
        self._direction: FloatArray | None = None
        self._shown_way = 0.0
        self._slide_information = settings.drag_sigma_slide**-2
        #: Estimated angle by which a cross slope turns a rod, rad per slope.
        self.slide = settings.drag_slide

    @property
    def whiskers(self) -> int:
        """How many the array has."""
        return self._layout.count

    def measure(
        self, stamp_ns: int, contacts: Contacts, velocity: FloatArray, covariance: FloatArray
    ) -> DragInformation | None:
        """Take a frame.

        Args:
            stamp_ns: of the frame.
            contacts: in base_link.
            velocity: estimated vx, vy (m/s), wz (rad/s), shape (3,).
            covariance: of the velocity, shape (3, 3).

        Returns:
            None where too few tips move, or too little way was made since the last measurement.
        """
        frames, settings = self._frames, self._settings
        frames.append((stamp_ns, contacts))
        before, self._last_ns = self._last_ns, stamp_ns
        if before is None:
            return None
        vx, vy, wz = velocity.tolist()
        speed = math.hypot(vx, vy) + ARM * abs(wz)
        self._way += speed * (stamp_ns - before) * 1e-9
        if self._way < settings.drag_spacing:
            return None
        way, self._way = self._way, 0.0
        span = (stamp_ns - frames[0][0]) * 1e-9
        if len(frames) <= WINDOW or span > MAX_AGE_S or len(contacts.index) < LEAST_TIPS:
            return None
        tips = self._trailing(contacts, frames[0][1], span, velocity)
        if tips is None:
            return None
        scaled = velocity * METRIC
        size = math.sqrt(scaled @ scaled)
        direction = self._direction
        if direction is None or direction @ scaled < SAME_DIRECTION * size:
            direction, self._shown_way = scaled / size, 0.0
        new_way = self._shown_way < settings.drag_length
        at = direction / METRIC * size
        found = self._information(tips, at)
        # Corrections of the velocity by what the frame says of it, and by the part of it that `slide` makes.
        told = np.array([found.vector, found.sliding_rows])
        corrections = np.linalg.solve(EYE + covariance.dot(found.information), covariance.dot(told.T))
        scaled = (velocity + corrections[:, 0]) * METRIC
        # Direction of the motion as this frame shows it: scaled (vx, vy, wz) of length one.
        shown = scaled / max(math.sqrt(scaled @ scaled), 1e-9)
        self._shown_way += way
        direction = direction + way / min(self._shown_way, SHOWN_LENGTH) * (shown - direction)
        self._direction = direction / math.sqrt(direction @ direction)
        speed = math.hypot(at[0], at[1])
        if new_way or speed < settings.drag_least_speed:
            return None
        discount = min(1.0, way / (2.0 * settings.drag_length))
        self._learn_slide(found, corrections, discount)
        shared = np.linalg.inv(EYE + found.information.dot(self._common(velocity))) * discount
        information = shared.dot(found.information)
        vector = shared.dot(found.vector)
        return DragInformation(0.5 * (information + information.T), vector, found.tips, at[:2] / speed)

    def _trailing(self, contacts: Contacts, old: Contacts, span: float, velocity: FloatArray) -> TrailingTips | None:
        index = contacts.index
        rod = contacts.rod[:2]
        earlier = np.full((2, self._layout.count), np.nan)
        earlier[:, old.index] = old.rod[:2]
        turning = (rod - earlier.take(index, axis=1)) / span
        p = self._p_base.take(index, axis=1) + rod
        swept = swept_by(p, turning, velocity)
        speed = np.sqrt(swept[0] ** 2 + swept[1] ** 2)
        d = rod / -np.sqrt(rod[0] ** 2 + rod[1] ** 2)
        ok = (
            self._floor[index]
            & (contacts.inclination > self._least_inclination)
            & (speed > self._settings.drag_least_speed)
            & (d[0] * swept[0] + d[1] * swept[1] > TRAILING * speed)
        )
        (of,) = ok.nonzero()
        if len(of) < LEAST_TIPS:
            return None
        gradient = self._slopes.gradient(contacts.points, index, of)
        return TrailingTips(p.take(of, 1), turning.take(of, 1), d.take(of, 1), gradient, swept.take(of, 1))

    def _information(self, tips: TrailingTips, at: FloatArray) -> FrameInformation:
        """What the tips say about the velocity's difference from its estimate, linearised at `at`."""
        rows, angle, cross, speed, weight = self._linearised(tips, swept_by(tips.p, tips.turning, at))
        steady = tips.swept - tips.turning
        innovation = angle * speed - (rows[0] * steady[0] + rows[1] * steady[1])
        weighted = rows * weight
        sliding = cross * speed
        return FrameInformation(
            weighted @ rows.T,
            weighted @ innovation,
            len(angle),
            weighted @ sliding,
            float(sliding @ (weight * sliding)),
            float(sliding @ (weight * innovation)),
        )

    def _linearised(
        self, tips: TrailingTips, swept: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Rows (3, m), angles from motion to rod (m,), cross slopes, speeds and weights at the motion `swept`."""
        speed = np.maximum(np.sqrt(swept[0] ** 2 + swept[1] ** 2), self._settings.drag_least_speed)
        ux, uy = swept / speed
        cross = np.minimum(np.maximum(ux * tips.gradient[1] - uy * tips.gradient[0], -STEEPEST), STEEPEST)
        angle = ux * tips.d[1] - uy * tips.d[0] - self.slide * cross
        # Perpendicular to the steady motion: that p' does not grow with the speed must not tell the speed, for p' is
        # mostly the ground's doing.
        sx, sy = swept - tips.turning
        steady = np.maximum(np.sqrt(sx**2 + sy**2), self._settings.drag_least_speed)
        sx, sy = sx / steady, sy / steady
        rows = np.empty((3, len(sx)))
        np.negative(sy, out=rows[0])
        rows[1] = sx
        np.add(sx * tips.p[0], sy * tips.p[1], out=rows[2])
        sigma2 = self._sigma2 * (1.0 + (cross / DOUBTFUL_SLOPE) ** 2)
        # Student's t with four degrees of freedom: a tip at a steep side counts little.
        weight = 5.0 / ((4.0 * sigma2 + angle**2) * speed**2)
        return rows, angle, cross, speed, weight

    def _common(self, velocity: FloatArray) -> FloatArray:
        """Covariance of the velocity that the array says, of what its tips have in common, shape (3, 3)."""
        settings = self._settings
        vx, vy, wz = velocity.tolist()
        speed = math.hypot(vx, vy)
        # What turning adds lasts longer than the rest: it counts as if it did not average out for so long.
        lasting = math.sqrt(max(settings.drag_turn_length / settings.drag_length, 1.0))
        turn = settings.drag_turn_share * abs(wz) * lasting
        side = (math.radians(settings.drag_common_deg) * speed) ** 2 + (turn * ARM) ** 2
        common = np.zeros((3, 3))
        if speed > 1e-9:
            x, y = -vy / speed, vx / speed
            common[0, 0], common[1, 1] = side * (x * x), side * (y * y)
            common[0, 1] = common[1, 0] = side * (x * y)
        else:
            common[0, 0] = common[1, 1] = side
        common[2, 2] = turn**2 + (settings.drag_common_curvature * speed) ** 2
        return common

    def _learn_slide(self, found: FrameInformation, corrections: FloatArray, discount: float) -> None:
        """Estimate `slide` from how the tips of this frame differ; what they have in common is the velocity's."""
        innovation, sliding = found.sliding_rows.dot(corrections).tolist()
        information = discount * max(found.sliding_sliding - sliding, 0.0)
        vector = discount * (found.sliding_innovation - innovation)
        settings = self._settings
        # The ground changes: what was learned fades towards the prior.
        prior = settings.drag_sigma_slide**-2
        kept = math.exp(-settings.drag_spacing / settings.drag_slide_length)
        self._slide_information = prior + kept * (self._slide_information - prior) + information
        faded = settings.drag_slide + kept * (self.slide - settings.drag_slide)
        self.slide = faded + vector / self._slide_information
