"""Touches of all keyframes: those used lately in memory, the others in a backing store that may be a disk.

Least recently used first: closures are searched around the robot, so what was not asked for in a long time lies far
away. A patch is written once, when it first leaves the memory.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.closure_search import Patch

FloatArray = NDArray[np.float64]


class PatchPages(Protocol):
    """Where touches wait; only what was written is read."""

    def write(self, key: int, points: FloatArray) -> None:
        """Keep the touches of a keyframe, shape (m, 3), m, to a tenth of a millimetre or better."""
        ...

    def read(self, key: int) -> FloatArray:
        """Touches that were written, shape (m, 3), m."""
        ...

    def delete(self, key: int) -> None:
        """Let go of a keyframe's touches."""
        ...


class PatchMemory(Mapping[int, Patch]):
    """Patches by keyframe; those without a way to disk stay in memory.

    Args:
        max_points: touches in memory at most, but for one patch.
        pages: where the others go; None keeps all in memory.

    Attributes:
        points_in_memory: touches that memory holds now.
        fetched: patches that were read back.
    """

    def __init__(self, max_points: int, pages: PatchPages | None) -> None:
        self._max_points = max_points
        self._pages = pages
        self._here: OrderedDict[int, Patch] = OrderedDict()
        self._away: dict[int, float] = {}
        self._written: set[int] = set()
        self.points_in_memory = 0
        self.fetched = 0

    def __setitem__(self, key: int, patch: Patch) -> None:
        self.pop(key)
        self._take_in(key, patch)

    def __getitem__(self, key: int) -> Patch:
        patch = self._here.get(key)
        if patch is not None:
            self._here.move_to_end(key)
            return patch
        travelled = self._away.pop(key)
        assert self._pages is not None
        self.fetched += 1
        patch = Patch(self._pages.read(key), travelled)
        self._take_in(key, patch)
        return patch

    def __contains__(self, key: object) -> bool:
        return key in self._here or key in self._away

    def __iter__(self) -> Iterator[int]:
        return iter(sorted([*self._here, *self._away]))

    def __len__(self) -> int:
        return len(self._here) + len(self._away)

    def pop(self, key: int) -> None:
        """Let go of a patch, if there is one."""
        patch = self._here.pop(key, None)
        if patch is not None:
            self.points_in_memory -= len(patch.points)
        self._away.pop(key, None)
        if key in self._written:
            self._written.discard(key)
            assert self._pages is not None
            self._pages.delete(key)

    def _take_in(self, key: int, patch: Patch) -> None:
        self._here[key] = patch
        self.points_in_memory += len(patch.points)
        while self._pages is not None and self.points_in_memory > self._max_points and len(self._here) > 1:
            oldest, gone = self._here.popitem(last=False)
            self.points_in_memory -= len(gone.points)
            self._away[oldest] = gone.travelled
            if oldest not in self._written:
                self._pages.write(oldest, gone.points)
                self._written.add(oldest)
