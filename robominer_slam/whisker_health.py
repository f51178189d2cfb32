"""Which whiskers can be believed: looks at the readings of the last second, all whiskers at once.

What each state is known by:

- silent: the device marks the sensor's reading as invalid.
- dead: all zeros, which a sensor that dropped off its bus reports.
- stuck: the same reading, bit for bit. A reading's noise is about one step on each of three axes, so it repeats about
  once in eighty frames; the firmware repeats the last value on a bus error.
- saturated: an axis at the end of the sensor's range.
- noisy: second differences in time far above the sensor's noise and above the other whiskers'.
- flipped: the field points away from the rest field farther than any calibrated bend can turn it, or the rod seems
  to bend against all others of its kind over a distance in which it must have turned over.
- broken: the field is far weaker or stronger than a whole magnet's (lost, or displaced), or the rod stays at rest
  while the robot moves and all its neighbours are bent.
- bent, drifting: told by `rest_tracking.py` (`set_rest_state`).

A whisker that is not well is left out of the map; it is back when nothing was wrong for a while.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.model import HealthSection
from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Whiskers whose mount directions differ by less than this hang alike: they trail alike.
COSINE_ALIKE = float(np.cos(np.deg2rad(20.0)))
#: Neighbours that are asked whether a whisker should be bent, and how many of them must be well to ask.
NEIGHBOURS, FEWEST_NEIGHBOURS = 6, 4
#: Length of the mean unit tilt of whiskers that trail alike: 1 if all point the same way.
COHERENT = 0.85
#: Cosine to that mean beyond which a rod bends against it.
AGAINST = -0.5


class WhiskerState(IntEnum):
    """How a whisker is; the order is that in which one fault hides another."""

    OK = 0
    DRIFTING = 1
    BENT = 2
    BROKEN = 3
    FLIPPED = 4
    NOISY = 5
    SATURATED = 6
    STUCK = 7
    DEAD = 8
    SILENT = 9


class WhiskerHealth:
    """Keeps the last frames and the whiskers' states.

    Attributes:
        state: of each whisker, values of `WhiskerState`, shape (n,).
        since_ns: stamp of the frame that began it, shape (n,).
    """

    def __init__(
        self, limits: HealthSection, layout: WhiskerLayout, rest_mT: FloatArray, fitted: BoolArray, *, folded: bool
    ) -> None:
        """Begin with an array that is taken to be well.

        Args:
            limits: of the faults.
            layout: of the array; its holes are always well.
            rest_mT: calibrated field at rest, shape (n, 3), mT.
            fitted: whiskers with a calibration, shape (n,); what needs one is not said of the others.
            folded: readings are negated where Bz < 0: a reversed field is nothing special.
        """
        n = layout.count
        self._limits, self._layout, self._folded = limits, layout, folded
        self.state: NDArray[np.int8] = np.zeros(n, dtype=np.int8)
        self.since_ns: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self._seen_ns: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self._fitted = fitted & layout.present
        self._rest_square = np.maximum(np.square(rest_mT).sum(axis=1), 1.0)
        self._rest_direction = (rest_mT / np.sqrt(self._rest_square)[:, None]).T
        # Twice the window, each frame written twice: the last frames in their order are always one slice. The
        # whiskers are the last axis, which numpy goes along fastest.
        twice = 2 * limits.window
        self._field = np.zeros((twice, 3, n))
        self._inclination = np.zeros((twice, n))
        self._valid = np.zeros((twice, n), dtype=np.bool_)
        self._position = np.zeros((twice, 2))
        self._twice = [
            part.reshape(2, limits.window, *part.shape[1:])
            for part in (self._field, self._inclination, self._valid, self._position)
        ]
        self._frames = 0
        self._well: BoolArray = np.ones(n, dtype=np.bool_)
        self._rest_state: NDArray[np.int8] = np.zeros(n, dtype=np.int8)
        self._against = np.zeros(n)
        self._looked_at = np.zeros(2)
        alike = _cosines(layout.R_base_whisker[:, :, 2]) > COSINE_ALIKE
        self._alike = (alike & layout.present & layout.present[:, None]).astype(np.float64)
        self._x_axis = np.ascontiguousarray(layout.R_base_whisker[:, :, 0].T)
        self._y_axis = np.ascontiguousarray(layout.R_base_whisker[:, :, 1].T)
        self._neighbours = _nearest(layout, alike)

    @property
    def well(self) -> BoolArray:
        """Which whiskers can be believed, shape (n,)."""
        return self._well

    def states(self) -> dict[int, tuple[WhiskerState, int]]:
        """Whiskers that are not well: index to state and the stamp at which it was found, ns."""
        ill = self.state.nonzero()[0].tolist()
        return {i: (WhiskerState(int(self.state[i])), int(self.since_ns[i])) for i in ill}

    def set_rest_state(self, state: NDArray[np.int8]) -> None:
        """What is known of the rest positions: OK, BENT or DRIFTING of each whisker, shape (n,)."""
        self._rest_state = state

    def update(
        self,
        stamp_ns: int,
        field_mT: FloatArray,
        valid: BoolArray,
        inclination: FloatArray,
        azimuth: FloatArray,
        position: FloatArray,
    ) -> BoolArray:
        """Take a frame.

        Args:
            stamp_ns: its time.
            field_mT: shape (n, 3), mT, as read.
            valid: as the device says, shape (n,).
            inclination, azimuth: of the rods as calibrated, shape (n,), rad.
            position: of base_link in odom, x and y, shape (2,), m.

        Returns:
            Which whiskers can be believed, shape (n,).
        """
        slot = self._frames % self._limits.window
        for part, value in zip(self._twice, (field_mT.T, inclination, valid, position), strict=True):
            part[:, slot] = value
        self._frames += 1
        if self._frames % self._limits.every == 0:
            self._look(stamp_ns, azimuth)
        return self.well

    def _look(self, stamp_ns: int, azimuth: FloatArray) -> None:
        """Find the faults that there are now; the worst of each whisker counts."""
        limits = self._limits
        found = self._rest_state.copy()
        end = (self._frames - 1) % limits.window + limits.window + 1
        if self._frames >= limits.window:
            last = slice(end - limits.window, end)
            self._from_window(found, self._field[last], self._inclination[last], self._position[last], azimuth)
        few = slice(end - limits.dead_frames, end)
        if self._frames >= limits.stuck_frames:
            same = self._field[end - limits.stuck_frames : end - 1] == self._field[end - 1]
            found[_all_of_both(same)] = WhiskerState.STUCK
        if self._frames >= limits.dead_frames:
            found[_all_of_both(self._field[few] == 0.0)] = WhiskerState.DEAD
            found[~np.logical_or.reduce(self._valid[few])] = WhiskerState.SILENT
        found[~self._layout.present] = WhiskerState.OK
        bad = found != WhiskerState.OK
        self._seen_ns[bad] = stamp_ns
        changed = bad & (found != self.state)
        changed |= ~bad & (self.state != WhiskerState.OK) & (stamp_ns - self._seen_ns > limits.recovery * 1e9)
        self.since_ns[changed] = stamp_ns
        self.state[changed] = found[changed]
        self._well = self.state == WhiskerState.OK

    def _from_window(
        self,
        found: NDArray[np.int8],
        field: FloatArray,
        inclination: FloatArray,
        position: FloatArray,
        azimuth: FloatArray,
    ) -> None:
        """Faults that take a full window, into `found`; arrays of its frames, oldest first, whiskers last."""
        limits, fitted = self._limits, self._fitted
        moved = math.dist(position[-1], position[0])
        low = np.minimum.reduce(inclination)
        idle = fitted & (np.maximum.reduce(inclination) < math.radians(limits.idle_deg))
        if moved >= limits.moved and idle.any():
            found[idle & self._neighbours_touch(low)] = WhiskerState.BROKEN
        total = np.add.reduce(field[limits.window // 2 :])
        mean = total / (limits.window - limits.window // 2)
        square = np.add.reduce(mean * mean)
        weak = square < limits.least_strength**2 * self._rest_square
        found[fitted & (weak | (square > limits.greatest_strength**2 * self._rest_square))] = WhiskerState.BROKEN
        turned = np.zeros_like(weak)
        if not self._folded:
            along = np.add.reduce(mean * self._rest_direction)
            turned = ~weak & (along < math.cos(math.radians(limits.greatest_turn_deg)) * np.sqrt(square))
        against = self._bends_against(position[-1], azimuth, low, turned)
        found[fitted & (turned | against)] = WhiskerState.FLIPPED
        first = field[1:] - field[:-1]
        second = first[1:] - first[:-1]
        # The median of |second difference| of white noise is 0.6745 sqrt(6) sigma; more than half above: noisy.
        high = np.abs(second, out=second) > 0.6745 * math.sqrt(6.0) * limits.noise
        noisy = 2 * np.add.reduce(high.reshape(-1, high.shape[-1]), dtype=np.intp) > 3 * len(second)
        # All at once is the ground or a knock, not the sensors.
        if np.count_nonzero(noisy) and 3 * np.count_nonzero(noisy) <= np.count_nonzero(self._layout.present):
            found[noisy] = WhiskerState.NOISY
        if field.max() >= limits.saturation or field.min() <= -limits.saturation:
            at_end = (np.abs(field) >= limits.saturation).any(axis=1)
            found[2 * at_end.sum(axis=0) > limits.window] = WhiskerState.SATURATED

    def _neighbours_touch(self, low: FloatArray) -> BoolArray:
        """Where all neighbours that are well, of enough, have been bent all the time; `low`: least inclination."""
        touching = low > math.radians(self._limits.bent_neighbours_deg)
        asked = (self._neighbours >= 0) & (self.state == WhiskerState.OK)[self._neighbours]
        enough: BoolArray = asked.sum(axis=1) >= FEWEST_NEIGHBOURS
        all_touch: BoolArray = (touching[self._neighbours] | ~asked).all(axis=1)
        return enough & all_touch

    def _bends_against(
        self, position: FloatArray, azimuth: FloatArray, low: FloatArray, turned: BoolArray
    ) -> BoolArray:
        """Rods that have bent against all others of their kind for too long a way.

        A field that has `turned` too far from rest says nothing of where its rod bends to.
        """
        limits = self._limits
        step = math.dist(position, self._looked_at)
        self._looked_at = position.copy()
        # A jump of odom is no way that was driven.
        step = step if step < 10.0 * limits.moved else 0.0
        own = self._x_axis * np.cos(azimuth) + self._y_axis * np.sin(azimuth)
        bent = low > math.radians(limits.idle_deg)
        asked = (bent & (self.state == WhiskerState.OK)).astype(np.float64)
        total = (own * asked) @ self._alike
        length = np.sqrt(np.add.reduce(total * total))
        count = asked @ self._alike
        along = np.add.reduce(own * total)
        coherent = bent & ~turned & (length > COHERENT * count) & (count >= FEWEST_NEIGHBOURS)
        self._against[coherent & (along > 0.0)] = 0.0
        self._against[coherent & (along < AGAINST * length)] += step
        against: BoolArray = self._against > limits.against
        return against


def _all_of_both(flags: BoolArray) -> BoolArray:
    """Whether all are true along the first two axes of shape (m, 3, n)."""
    result: BoolArray = np.logical_and.reduce(flags.reshape(-1, flags.shape[-1]))
    return result


def _cosines(axis: FloatArray) -> FloatArray:
    cosines: FloatArray = axis @ axis.T
    return cosines


def _nearest(layout: WhiskerLayout, alike: BoolArray) -> NDArray[np.intp]:
    """The nearest whiskers that hang alike, shape (n, NEIGHBOURS); -1 where there are fewer."""
    distance = np.linalg.norm(layout.p_base[:, None] - layout.p_base[None], axis=-1)
    distance[~(alike & layout.present)] = np.inf
    np.fill_diagonal(distance, np.inf)
    count = min(NEIGHBOURS, layout.count)
    nearest = np.argsort(distance, axis=1)[:, :count]
    return np.where(np.isfinite(np.take_along_axis(distance, nearest, axis=1)), nearest, -1)
