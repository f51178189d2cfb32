"""Follows the whiskers' rest positions: re-zeroes those that provably touch nothing, slowly; finds bent rods.

A reading is steady while it stays within the noise of one place. A steady reading near rest, over a way on which any
ground would have moved the rod, is a rod that hangs free, but for one case: a tip that is dragged over flat ground,
just lightly. That rod trails: its mean tilt is against the motion. Such a reading is never taken as rest; drift in
that direction is followed when the robot drives another way.

A reading that is steady off rest is a dragged tip as well, as long as the motion's direction stays the same. If the
robot has driven in another direction since, and the tilt is the same in the whisker's frame, nothing drags it: the
rod is bent.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.model import HealthSection
from robominer_slam.layout import WhiskerLayout
from robominer_slam.whisker_health import WhiskerState

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: A rod that hangs more inclined than this is not merely bent.
GREATEST_BEND = math.radians(15.0)
#: Two directions of motion that differ by this much would drag a tip to two sides.
COSINE_OTHER_WAY = math.cos(math.radians(60.0))
#: Steady tilts that are the same, rad: three times the error of a mean over an episode.
SAME_TILT = math.radians(0.8)
#: Fewest frames in an episode: a deviation from fewer says nothing.
FEWEST_FRAMES = 6
#: Where more than this share of the array seems bent, something bends it: flowing water.
MOST_BENT = 0.25


class RestTracker:
    """Watches steady readings of n whiskers.

    Attributes:
        followed: how far each rest position has been followed, as tilt, shape (2, n), rad.
        state: OK, BENT or DRIFTING of each whisker, values of `WhiskerState`, shape (n,).
    """

    def __init__(self, limits: HealthSection, layout: WhiskerLayout) -> None:
        """Begin with the calibrated rest positions."""
        n = layout.count
        self._limits, self._layout = limits, layout
        self.followed = np.zeros((2, n))
        self.state: NDArray[np.int8] = np.zeros(n, dtype=np.int8)
        self._anchor = np.full((2, n), np.nan)
        # Sums over the episode: tilt, its squares, 1.
        self._sums = np.zeros((5, n))
        self._terms = np.ones((5, n))
        self._start = np.zeros((2, n))
        self._start_ns: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        # Tilt and direction of motion, in base_link, of the last steady reading off rest.
        self._steady_tilt = np.full((2, n), np.nan)
        self._steady_way = np.zeros((2, n))
        self._bent = np.zeros(n, dtype=np.bool_)
        self._x_axis = np.ascontiguousarray(layout.R_base_whisker[:, :2, 0].T)
        self._y_axis = np.ascontiguousarray(layout.R_base_whisker[:, :2, 1].T)

    def update(
        self,
        stamp_ns: int,
        usable: BoolArray,
        inclination: FloatArray,
        azimuth: FloatArray,
        pose: tuple[float, float, float],
    ) -> FloatArray | None:
        """Take a frame.

        Args:
            stamp_ns: its time.
            usable: whiskers whose angles may be used, shape (n,); bent and drifting ones included.
            inclination, azimuth: about the rest positions followed so far, shape (n,), rad.
            pose: of base_link in odom, x, y (m) and heading (rad).

        Returns:
            How far each rest position is to be moved, as tilt, shape (2, n), rad, zero for most; None for all zero.
        """
        near = usable & (inclination < GREATEST_BEND)
        if not np.count_nonzero(near) and not np.count_nonzero(self._sums[4]):
            return None
        terms = self._terms
        tilt = terms[:2]
        np.multiply(inclination, np.cos(azimuth), out=tilt[0])
        np.multiply(inclination, np.sin(azimuth), out=tilt[1])
        np.multiply(tilt, tilt, out=terms[2:4])
        off = tilt - self._anchor
        inside = near & (np.add.reduce(off * off) < math.radians(self._limits.rest_deg) ** 2)
        begin = ~inside
        here = np.array([[pose[0]], [pose[1]]])
        np.copyto(self._anchor, np.where(near, tilt, np.nan), where=begin)
        np.copyto(self._start, here, where=begin)
        self._start_ns[begin] = stamp_ns
        self._sums *= inside
        self._sums += terms * near
        way = here - self._start
        distance = np.sqrt(np.add.reduce(way * way))
        done = (distance >= self._limits.rest_distance) & (self._sums[4] >= FEWEST_FRAMES)
        if not np.count_nonzero(done):
            return None
        c, s = math.cos(pose[2]), math.sin(pose[2])
        way = np.stack([c * way[0] + s * way[1], c * way[1] - s * way[0]]) / np.maximum(distance, 1e-9)
        shift = self._finish(stamp_ns, np.flatnonzero(done), way)
        # A next episode begins around the mean of this one's readings.
        self._sums[:, done] = 0.0
        self._start[0, done], self._start[1, done] = pose[0], pose[1]
        self._start_ns[done] = stamp_ns
        return shift

    def _finish(self, stamp_ns: int, done: NDArray[np.intp], way: FloatArray) -> FloatArray | None:
        """Judge the whiskers whose readings have been steady for long enough; `way`: motion in base_link."""
        limits = self._limits
        sums = self._sums[:, done]
        mean, square = sums[:2] / sums[4], sums[2:4] / sums[4]
        self._anchor[:, done] = mean
        steady = (square - mean * mean).max(axis=0) < math.radians(limits.rest_noise_deg) ** 2
        size = np.sqrt(np.add.reduce(mean * mean))
        near = size < math.radians(limits.rest_deg)
        ahead = (self._x_axis * way).sum(axis=0)[done] * mean[0] + (self._y_axis * way).sum(axis=0)[done] * mean[1]
        at_rest = steady & near & (-ahead < math.radians(limits.rest_trail_deg))
        self._find_bent(done[steady & ~near], mean[:, steady & ~near], way)
        self._bent[done[at_rest]] = False
        self._set_state()
        if not at_rest.any():
            return None
        elapsed = (stamp_ns - self._start_ns[done]) * 1e-9
        most = math.radians(limits.rest_rate) * elapsed
        shift = np.zeros_like(self.followed)
        shift[:, done] = mean * (at_rest * np.minimum(1.0, most / np.maximum(size, 1e-9)))
        self.followed += shift
        return shift

    def _find_bent(self, who: NDArray[np.intp], tilt: FloatArray, way: FloatArray) -> None:
        """Whiskers steady off rest, `tilt` of shape (2, m): bent where the robot drove another way before."""
        before, before_way = self._steady_tilt[:, who], self._steady_way[:, who]
        off = tilt - before
        same = np.add.reduce(off * off) < SAME_TILT**2
        other_way = np.add.reduce(before_way * way[:, who]) < COSINE_OTHER_WAY
        self._bent[who[same & other_way]] = True
        # A tilt that is the same is kept with the way on which it was first seen.
        new = who[~same]
        self._bent[new] = False
        self._steady_tilt[:, new], self._steady_way[:, new] = tilt[:, ~same], way[:, new]

    def _set_state(self) -> None:
        self.state[:] = WhiskerState.OK
        crept = np.add.reduce(self.followed * self.followed) > math.radians(self._limits.drift_deg) ** 2
        self.state[crept] = WhiskerState.DRIFTING
        if np.count_nonzero(self._bent) <= MOST_BENT * np.count_nonzero(self._layout.present):
            self.state[self._bent] = WhiskerState.BENT

    def reset(self) -> None:
        """The rest positions were taken anew: forget what was followed."""
        self.followed[:] = 0.0
        self._sums[:] = 0.0
        self._anchor[:] = self._steady_tilt[:] = np.nan
        self._bent[:] = False
        self._set_state()
