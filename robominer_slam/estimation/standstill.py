"""Standing still, as the whiskers feel it: holds a ready-made odometry back until it is known whether the robot moved.

A ready-made odometry goes on reading its bias and its noise while the robot stands: 0.7 deg in two seconds. Rods that
keep their directions say that it stands - but late, since they turn by more than their noise only after some
millimetres, and not at all where trailing leaves them as they are, on flat ground. So readings wait while the rods
rest. If the rods turn, what was read since they may have begun to counts as motion: no start is missed. If the readings
of the last tenths of a second or of the last seconds add up to a motion, all that wait do. Those from deep within a
standstill tell the bias.

Zero-velocity updates are known from strapdown navigation (Skog et al., "Zero-velocity detection", IEEE Trans. Biomed.
Eng. 2010); there as here the detector is a likelihood ratio between standing and moving, over a short window.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts

FloatArray = NDArray[np.float64]

#: Time over which rods must keep their directions, s; a robot at 0.15 m/s has made 6 cm in it.
WINDOW_S = 0.4
#: At the start, before there is a whole window, this much tells.
LEAST_WINDOW_S = 0.1
#: Lengths over which readings must not add up to a motion, s, and how long they wait.
SPANS_S = (0.4, 0.8, 1.6, 3.2)
WAIT_S = 2.0
#: Longer than this without a verdict of the rods, s: readings count as motion.
MAX_SILENCE_S = 0.5
#: Fewer touching rods than this say nothing.
LEAST_RODS = 6
#: Squared deviations, per axis, up to which an odometry's readings may begin a standstill, and beyond which they end
#: one: looked at thirty times a second, they pass three deviations by chance, and five in a year.
BEGINS, ENDS = 9.0, 25.0


@dataclass(frozen=True, slots=True)
class OdometryReading:
    """Body velocity (vx, vy, wz), m/s and rad/s, shape (3,), mean over the interval (s) that ends at the stamp."""

    stamp_ns: int
    interval: float
    velocity: FloatArray


@dataclass(frozen=True, slots=True)
class SortedReadings:
    """Readings from deep within a standstill, then others of a robot that stood, then those of motion."""

    stood: list[OdometryReading]
    rested: list[OdometryReading]
    moved: list[OdometryReading]


class Standstill:
    """Sorts readings into those of motion and those of standing.

    Args:
        settings: noise and limits, with units and reasons there.
        whiskers: how many there are.

    Attributes:
        holds: the robot stands, as far as is known; readings wait. So it is at the start.
    """

    def __init__(self, settings: RobustEstimationSection, whiskers: int) -> None:
        self._rest = math.radians(settings.rest_deg)
        self._noise = settings.sigma_odometry**2 / 30.0
        self._whiskers = whiskers
        self._frames: deque[tuple[int, FloatArray]] = deque()
        self._recent: deque[OdometryReading] = deque()
        self._waiting: deque[OdometryReading] = deque()
        self._released: list[OdometryReading] = []
        self._stood: list[OdometryReading] = []
        self._rested: list[OdometryReading] = []
        self._told_ns: int | None = None
        self._refused = False
        self._at_start: tuple[FloatArray, FloatArray] | None = None
        self.holds = True

    def add(self, reading: OdometryReading, bias: FloatArray, variance: FloatArray) -> None:
        """Take a reading of the odometry.

        Args:
            reading: in the order of stamps.
            bias: as estimated, shape (3,), and its variance, shape (3,).
        """
        recent, now = self._recent, reading.stamp_ns
        recent.append(reading)
        while (now - recent[0].stamp_ns) * 1e-9 >= (SPANS_S[-1] if self.holds else SPANS_S[0]):
            recent.popleft()
        if not self.holds:
            self._released.append(reading)
            return
        self._waiting.append(reading)
        if self._at_start is None:
            self._at_start = bias.copy(), variance.copy()
        if self._told_ns is None:
            self._told_ns = now
        if (now - self._told_ns) * 1e-9 > MAX_SILENCE_S:
            self._release()
        elif self._moves(*self._at_start, ENDS):
            # The rods say that nothing moves, and are wrong: what they say counts again once they have turned.
            self._refused = True
            self._release()
        self._stood.extend(self._waited(WAIT_S))

    def see(self, stamp_ns: int, contacts: Contacts, bias: FloatArray, variance: FloatArray) -> bool:
        """Take a frame's contacts; whether the robot has come to a standstill with it. Bias as of `add`."""
        rests = self._rods_rest(stamp_ns, contacts)
        if rests is None:
            return False
        self._told_ns = stamp_ns
        if not rests:
            self._refused = False
            if self.holds:
                # These may be of the last creeping before the stop or the first after it: they tell no bias.
                self._rested.extend(self._waited(WINDOW_S))
                self._release()
            return False
        if self.holds or self._refused or self._moves(bias, variance, BEGINS):
            return False
        self.holds, self._at_start = True, (bias.copy(), variance.copy())
        return True

    def sorted(self) -> SortedReadings:
        """Readings of which there is no doubt any more; each is given once."""
        out = SortedReadings(self._stood, self._rested, self._released)
        self._stood, self._rested, self._released = [], [], []
        return out

    def _waited(self, longer_s: float) -> list[OdometryReading]:
        """Take those out that have waited longer than this."""
        waiting, out = self._waiting, []
        while waiting and (self._recent[-1].stamp_ns - waiting[0].stamp_ns) * 1e-9 > longer_s:
            out.append(waiting.popleft())
        return out

    def _release(self) -> None:
        self.holds, self._at_start = False, None
        self._released.extend(self._waiting)
        self._waiting.clear()

    def _moves(self, bias: FloatArray, variance: FloatArray, sure: float) -> bool:
        """Whether the last readings, over any of the spans, add up to more than those of a robot that stands."""
        recent = self._recent
        if not recent:
            return False
        intervals = np.array([reading.interval for reading in recent])[::-1]
        off = np.array([reading.velocity for reading in recent])[::-1] - bias
        time, total = np.cumsum(intervals), np.cumsum(off * intervals[:, None], axis=0)
        spans = np.minimum(np.searchsorted(time, SPANS_S), len(time) - 1)
        time, total = time[spans, None], total[spans]
        return bool((total**2 > sure * (self._noise * time + variance * time**2)).any())

    def _rods_rest(self, stamp_ns: int, contacts: Contacts) -> bool | None:
        """Whether most rods have kept their directions for a window; None where too few say so."""
        frames = self._frames
        directions = np.full((3, self._whiskers), np.nan)
        rod = contacts.rod
        directions[:, contacts.index] = rod / np.sqrt((rod**2).sum(axis=0))
        frames.append((stamp_ns, directions))
        while len(frames) > 1 and (stamp_ns - frames[1][0]) * 1e-9 >= WINDOW_S:
            frames.popleft()
        before_ns, before = frames[0]
        if not LEAST_WINDOW_S <= (stamp_ns - before_ns) * 1e-9 <= 2.0 * WINDOW_S:
            return None
        change = np.sqrt(((directions - before) ** 2).sum(axis=0))
        change = change[np.isfinite(change)]
        if len(change) < LEAST_RODS:
            return None
        return float(np.median(change)) < self._rest
