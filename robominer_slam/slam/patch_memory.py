"""Touches of all keyframes: those used lately in memory, the others in a backing store that may be a disk.

Least recently used first: closures are searched around the robot, so what was not asked for in a long time lies far
away. A patch is written once, when it first leaves the memory.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.patch import Patch, no_touches

FloatArray = NDArray[np.float64]


#: A patch in memory: touches of the floor, way driven, touches of walls.
Kept: TypeAlias = tuple[NDArray[np.float32], float, NDArray[np.float32]]


class PatchPages(Protocol):
    """Where touches wait; only what was written is read. All of it may raise OSError."""

    def write(self, key: int, points: NDArray[np.float32]) -> None:
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
        fault: why nothing is paged any more, and memory grows instead; empty if all is well.
    """

    def __init__(self, max_points: int, pages: PatchPages | None) -> None:
        self._max_points = max_points
        self._pages = pages
        #: As float32, which is exact to 0.1 micrometres: half of the memory. Copies, without what views hold on to.
        self._here: OrderedDict[int, Kept] = OrderedDict()
        self._away: dict[int, float] = {}
        self._written: set[int] = set()
        self._walled: set[int] = set()
        self.points_in_memory = 0
        self.fetched = 0
        self.fault = ""

    def __setitem__(self, key: int, patch: Patch) -> None:
        self.pop(key)
        self._take_in(key, patch)

    def __getitem__(self, key: int) -> Patch:
        if key in self._here:
            self._here.move_to_end(key)
            points, travelled, walls = self._here[key]
            return Patch(points.astype(np.float64), travelled, walls.astype(np.float64))
        floor, beside = self._read(key)
        patch = Patch(floor, self._away.pop(key), beside)
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
        if key in self._here:
            self.points_in_memory -= _touches(self._here.pop(key))
        self._away.pop(key, None)
        if key in self._written:
            self._written.discard(key)
            self._delete(key)

    def _take_in(self, key: int, patch: Patch) -> None:
        self._here[key] = patch.points.astype(np.float32), patch.travelled, patch.walls.astype(np.float32)
        self.points_in_memory += len(patch)
        while self.points_in_memory > self._max_points and len(self._here) > 1 and self._write(next(iter(self._here))):
            oldest, gone = self._here.popitem(last=False)
            self.points_in_memory -= _touches(gone)
            self._away[oldest] = gone[1]

    def _write(self, key: int) -> bool:
        """Whether a patch is in the pages."""
        if key in self._written:
            return True
        if self._pages is None or self.fault:
            return False
        try:
            points, _, walls = self._here[key]
            self._pages.write(key, points)
            if len(walls):
                # Under a key that no keyframe has.
                self._pages.write(~key, walls)
                self._walled.add(key)
        except OSError as error:
            self.fault = str(error)
            return False
        self._written.add(key)
        return True

    def _read(self, key: int) -> tuple[FloatArray, FloatArray]:
        """Touches of floor and walls that are away; none where they cannot be read: unknown ground is not matched."""
        assert self._pages is not None
        self.fetched += 1
        try:
            return self._pages.read(key), self._pages.read(~key) if key in self._walled else no_touches()
        except OSError as error:
            self.fault = str(error)
            return no_touches(), no_touches()

    def _delete(self, key: int) -> None:
        assert self._pages is not None
        try:
            self._pages.delete(key)
            if key in self._walled:
                self._walled.discard(key)
                self._pages.delete(~key)
        except OSError as error:
            self.fault = str(error)


def _touches(kept: Kept) -> int:
    points, _, walls = kept
    return len(points) + len(walls)
