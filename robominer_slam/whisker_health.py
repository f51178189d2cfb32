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
from robominer_slam.reading_window import ReadingWindow

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


#: As numpy's own numbers: to compare an array with a member of an enumeration takes four times as long.
_OK, _BENT = np.int8(WhiskerState.OK), np.int8(WhiskerState.BENT)
_ZERO = np.zeros(1)


class WhiskerHealth:
    """Keeps the last frames and the whiskers' states.

    Attributes:
        state: of each whisker, values of `WhiskerState`, shape (n,).
        since_ns: stamp of the frame that began it, shape (n,).
        well: which whiskers can be believed, shape (n,).
        watched: those, and bent and drifting ones, shape (n,).
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
        self.well: BoolArray = np.ones(n, dtype=np.bool_)
        self.watched: BoolArray = np.ones(n, dtype=np.bool_)
        self.since_ns: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self._seen_ns: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self._fitted = fitted & layout.present
        self._rest_square = np.maximum(np.square(rest_mT).sum(axis=1), 1.0)
        self._least_square = limits.least_strength**2 * self._rest_square
        self._greatest_square = limits.greatest_strength**2 * self._rest_square
        self._rest_direction = (rest_mT / np.sqrt(self._rest_square)[:, None]).T
        self._window = ReadingWindow(limits.window, n, limits.noise)
        self._rest_state: NDArray[np.int8] = np.zeros(n, dtype=np.int8)
        self._against = np.zeros(n)
        self._looked_at = (0.0, 0.0)
        self._hole = ~layout.present
        alike = _cosines(layout.R_base_whisker[:, :, 2]) > COSINE_ALIKE
        # Whiskers that are alike to the same others are of one kind: sums are made once for each. The sum of a single
        # kind is that of all.
        kinds, kind = np.unique(alike & layout.present & layout.present[:, None], axis=0, return_inverse=True)
        self._kind = kind.reshape(-1) if len(kinds) > 1 else np.zeros(1, dtype=np.intp)
        self._of_kind = np.ascontiguousarray(kinds.T, dtype=np.float64)
        self._x_axis = np.ascontiguousarray(layout.R_base_whisker[:, :, 0].T)
        self._y_axis = np.ascontiguousarray(layout.R_base_whisker[:, :, 1].T)
        self._neighbours = _nearest(layout, alike)

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
        position: tuple[float, float],
    ) -> BoolArray:
        """Take a frame.

        Args:
            stamp_ns: its time.
            field_mT: shape (n, 3), mT, as read.
            valid: as the device says, shape (n,).
            inclination, azimuth: of the rods as calibrated, shape (n,), rad.
            position: of base_link in odom, x and y, m.

        Returns:
            Which whiskers can be believed, shape (n,).
        """
        self._window.add(field_mT, inclination, valid, position)
        if self._window.frames % self._limits.every == 0:
            self._window.take_in()
            self._look(stamp_ns, azimuth)
        return self.well

    def _look(self, stamp_ns: int, azimuth: FloatArray) -> None:
        """Find the faults that there are now; the worst of each whisker counts."""
        limits, window = self._limits, self._window
        found = self._rest_state.copy()
        if window.frames >= limits.window:
            self._from_window(found, azimuth)
        field, valid = window.field_mT, window.valid
        if window.frames >= limits.stuck_frames:
            _mark_all(found, WhiskerState.STUCK, field[-limits.stuck_frames : -1], field[-1])
        if window.frames >= limits.dead_frames:
            _mark_all(found, WhiskerState.DEAD, field[-limits.dead_frames :], _ZERO)
            if np.count_nonzero(valid[-1]) < len(found):
                found[~np.logical_or.reduce(valid[-limits.dead_frames :])] = WhiskerState.SILENT
        found[self._hole] = WhiskerState.OK
        if np.count_nonzero(found) or np.count_nonzero(self.state):
            self._change(stamp_ns, found)

    def _change(self, stamp_ns: int, found: NDArray[np.int8]) -> None:
        bad = found != _OK
        self._seen_ns[bad] = stamp_ns
        changed = bad & (found != self.state)
        changed |= ~bad & ~self.well & (stamp_ns - self._seen_ns > self._limits.recovery * 1e9)
        self.since_ns[changed] = stamp_ns
        self.state[changed] = found[changed]
        self.well = self.state == _OK
        self.watched = self.state <= _BENT

    def _from_window(self, found: NDArray[np.int8], azimuth: FloatArray) -> None:
        """Faults that take a full window, into `found`."""
        limits, fitted, window = self._limits, self._fitted, self._window
        low = np.minimum.reduce(window.inclination)
        rested = fitted & (low < math.radians(limits.idle_deg))
        if window.way >= limits.moved and np.count_nonzero(rested):
            idle = rested & (np.maximum.reduce(window.inclination) < math.radians(limits.idle_deg))
            self._find_broken(found, np.flatnonzero(idle), low)
        half = window.field_mT[limits.window // 2 :]
        mean = np.add.reduce(half) / len(half)
        square = np.add.reduce(mean * mean)
        weak = square < self._least_square
        found[fitted & (weak | (square > self._greatest_square))] = WhiskerState.BROKEN
        turned = np.zeros_like(weak)
        if not self._folded:
            along = np.add.reduce(mean * self._rest_direction)
            turned = ~weak & (along < math.cos(math.radians(limits.greatest_turn_deg)) * np.sqrt(square))
        against = self._bends_against(azimuth, low, turned)
        found[fitted & (turned | against)] = WhiskerState.FLIPPED
        # More than half of the second differences are above their median if that were noise.
        noisy = 2 * np.add.reduce(window.rough, dtype=np.intp) > 3 * len(window.rough)
        count = np.count_nonzero(noisy)
        # All at once is the ground or a knock, not the sensors.
        if count and 3 * count <= np.count_nonzero(self._layout.present):
            found[noisy] = WhiskerState.NOISY
        # What is at the end for more than half of the window is so once in its second half.
        if half.max() >= limits.saturation or half.min() <= -limits.saturation:
            at_end = (np.abs(window.field_mT) >= limits.saturation).any(axis=1)
            found[2 * at_end.sum(axis=0) > limits.window] = WhiskerState.SATURATED

    def _find_broken(self, found: NDArray[np.int8], idle: NDArray[np.intp], low: FloatArray) -> None:
        """Idle whiskers all of whose neighbours that are well, of enough, have been bent all the time.

        `low` is the least inclination of each whisker.
        """
        if not len(idle):
            return
        touching = low > math.radians(self._limits.bent_neighbours_deg)
        neighbours = self._neighbours[idle]
        asked = (neighbours >= 0) & self.well[neighbours]
        enough = asked.sum(axis=1) >= FEWEST_NEIGHBOURS
        found[idle[enough & (touching[neighbours] | ~asked).all(axis=1)]] = WhiskerState.BROKEN

    def _bends_against(self, azimuth: FloatArray, low: FloatArray, turned: BoolArray) -> BoolArray:
        """Rods that have bent against all others of their kind for too long a way.

        A field that has `turned` too far from rest says nothing of where its rod bends to.
        """
        limits, position = self._limits, self._window.position
        step = math.dist(position, self._looked_at)
        self._looked_at = position
        # A jump of odom is no way that was driven.
        step = step if step < 10.0 * limits.moved else 0.0
        own = self._x_axis * np.cos(azimuth) + self._y_axis * np.sin(azimuth)
        bent = low > math.radians(limits.idle_deg)
        asked = (bent & self.well).astype(np.float64)
        total = ((own * asked) @ self._of_kind).take(self._kind, axis=1)
        length = np.sqrt(np.add.reduce(total * total))
        along = np.add.reduce(own * total)
        contrary = bent & (along < AGAINST * length)
        if not np.count_nonzero(contrary) and not np.count_nonzero(self._against):
            return np.zeros_like(bent)
        count = (asked @ self._of_kind)[self._kind]
        coherent = bent & ~turned & (length > COHERENT * count) & (count >= FEWEST_NEIGHBOURS)
        self._against[coherent & (along > 0.0)] = 0.0
        self._against[coherent & contrary] += step
        against: BoolArray = self._against > limits.against
        return against


def _mark_all(found: NDArray[np.int8], state: WhiskerState, fields: FloatArray, value: FloatArray) -> None:
    """Mark whiskers whose fields, shape (m, 3, n), are all equal to `value`, shape (3, n) or (1,)."""
    # Nearly always the oldest of them tells that it is none.
    if np.count_nonzero(np.logical_and.reduce(fields[0] == value)):
        same = fields == value
        found[np.logical_and.reduce(same.reshape(-1, same.shape[-1]))] = state


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
