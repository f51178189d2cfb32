"""The last frames' readings of all whiskers, for those who judge by more than one frame.

Frames are put down as they come and taken into the window several at once: that costs as much as one alone.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class ReadingWindow:
    """A window of `length` frames of n whiskers, oldest first; whiskers are the last axis, the fastest in numpy.

    Attributes:
        frames: how many were added.
        field_mT: as read, shape (length, 3, n), mT.
        inclination: shape (length, n), rad.
        valid: as the device says, shape (length, n).
        rough: of how many axes the field's second difference in time is beyond the noise, shape (length - 2, n).
    """

    def __init__(self, length: int, n: int, noise_mT: float) -> None:
        """An empty window.

        Args:
            length: frames in it, at least 3.
            n: whiskers.
            noise_mT: standard deviation that is too much for a sensor's noise, mT.
        """
        self.frames = 0
        self.field_mT = np.zeros((length, 3, n))
        self.inclination = np.zeros((length, n))
        self.valid: BoolArray = np.zeros((length, n), dtype=np.bool_)
        self.rough: NDArray[np.uint8] = np.zeros((length - 2, n), dtype=np.uint8)
        self._position: deque[tuple[float, float]] = deque(maxlen=length)
        self._new: deque[tuple[FloatArray, FloatArray, BoolArray]] = deque(maxlen=length)
        # The median of |second difference| of white noise is 0.6745 sqrt(6) sigma.
        self._limit_mT = 0.6745 * math.sqrt(6.0) * noise_mT

    def add(
        self, field_mT: FloatArray, inclination: FloatArray, valid: BoolArray, position: tuple[float, float]
    ) -> None:
        """Put a frame down; its arrays, shape (n, 3), (n,) and (n,), must stay as they are."""
        self.frames += 1
        self._new.append((field_mT, inclination, valid))
        self._position.append(position)

    def take_in(self) -> None:
        """Move the window on to the last frame that was added."""
        count = len(self._new)
        if not count:
            return
        fields, inclinations, valids = zip(*self._new, strict=True)
        self._new.clear()
        _move(self.field_mT, np.array(fields).transpose(0, 2, 1))
        _move(self.inclination, inclinations)
        _move(self.valid, valids)
        last = self.field_mT[-count - 2 :]
        first = last[1:] - last[:-1]
        second = first[1:] - first[:-1]
        high = np.abs(second, out=second) > self._limit_mT
        _move(self.rough, np.add.reduce(high.view(np.uint8), axis=1, dtype=np.uint8))

    @property
    def position(self) -> tuple[float, float]:
        """Of base_link at the last frame."""
        return self._position[-1]

    @property
    def way(self) -> float:
        """From the first frame's position to the last one's, m."""
        return math.dist(self._position[0], self._position[-1])


def _move(window: NDArray[np.generic], new: object) -> None:
    """Append along the first axis, and drop as many from the front."""
    values = np.asarray(new)
    window[: -len(values)] = window[len(values) :]
    window[-len(values) :] = values
