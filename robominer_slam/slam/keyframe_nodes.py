"""Nodes of the level graph as arrays, in the order of their ids, which stay what they are when others go."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robominer_slam.slam.growing_array import GrowingArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]


class KeyframeNodes(Mapping[int, FloatArray]):
    """Keyframes by id: as a mapping, their poses x, y (m), heading (rad) in map, shape (3,).

    Attributes:
        version: grows when nodes come or go.
    """

    def __init__(self) -> None:
        self.version = 0
        self._ids = GrowingArray((), np.int64)
        self._poses = GrowingArray((3,), np.float64)
        self._heights = GrowingArray((), np.float64)
        self._tilts = GrowingArray((3, 3), np.float64)
        self._travelled = GrowingArray((), np.float64)
        self._mapped = GrowingArray((), np.bool_)

    def append(self, key: int, pose: FloatArray, height: float, tilt: FloatArray, travelled: float) -> None:
        """Add a keyframe.

        Args:
            key: its id, above all others.
            pose: x, y, heading, shape (3,).
            height: z, m.
            tilt: R with R_map_base = R_z(heading) R, shape (3, 3).
            travelled: way driven up to it, m.

        Raises:
            ValueError: the id is not above the others.
        """
        if len(self._ids) and key <= self._ids.view[-1]:
            raise ValueError(f"keyframe {key} after keyframe {self._ids.view[-1]}; expected growing ids")
        self._ids.extend([key])
        self._poses.extend(pose[None])
        self._heights.extend([height])
        self._tilts.extend(tilt[None])
        self._travelled.extend([travelled])
        self._mapped.extend([True])
        self.version += 1

    def put_before(self, others: KeyframeNodes) -> None:
        """Add the keyframes of `others`, whose ids lie below all of these.

        Raises:
            ValueError: they do not.
        """
        if len(self) and len(others) and others.ids[-1] >= self.ids[0]:
            raise ValueError(f"keyframe {others.ids[-1]} before keyframe {self.ids[0]}; expected growing ids")
        for own, other in zip(self._columns(), others._columns(), strict=True):
            rows = own.view.copy()
            own.keep(np.zeros(len(rows), dtype=np.bool_))
            own.extend(other.view)
            own.extend(rows)
        self.version += 1

    def remove(self, keys: ArrayLike) -> None:
        """Let keyframes go."""
        kept = np.ones(len(self), dtype=np.bool_)
        kept[self.rows(keys)] = False
        for column in self._columns():
            column.keep(kept)
        self.version += 1

    def rows(self, keys: ArrayLike) -> IndexArray:
        """Places of ids, shape (m,), in the arrays; all of them must be there."""
        return np.searchsorted(self._ids.view, np.asarray(keys, dtype=np.int64))

    def row(self, key: int) -> int:
        """Place of one id.

        Raises:
            KeyError: there is no such keyframe.
        """
        row = int(np.searchsorted(self._ids.view, key))
        if row >= len(self._ids) or self._ids.view[row] != key:
            raise KeyError(key)
        return row

    def _columns(self) -> tuple[GrowingArray, ...]:
        return self._ids, self._poses, self._heights, self._tilts, self._travelled, self._mapped

    def __getitem__(self, key: int) -> FloatArray:
        pose: FloatArray = self._poses.view[self.row(key)].copy()
        return pose

    def __contains__(self, key: object) -> bool:
        row = int(np.searchsorted(self._ids.view, key)) if isinstance(key, int) else len(self._ids)
        return row < len(self._ids) and bool(self._ids.view[row] == key)

    def __len__(self) -> int:
        return len(self._ids)

    def __iter__(self) -> Iterator[int]:
        return iter(self._ids.view.tolist())

    def height(self, key: int) -> float:
        """Z of a keyframe in map, m."""
        return float(self._heights.view[self.row(key)])

    def tilt(self, key: int) -> FloatArray:
        """Tilt of a keyframe, shape (3, 3)."""
        tilt: FloatArray = self._tilts.view[self.row(key)]
        return tilt

    @property
    def ids(self) -> NDArray[np.int64]:
        """Shape (n,), growing."""
        return self._ids.view

    @property
    def poses(self) -> FloatArray:
        """Shape (n, 3)."""
        return self._poses.view

    @property
    def heights(self) -> FloatArray:
        """Shape (n,), m."""
        return self._heights.view

    @property
    def tilts(self) -> FloatArray:
        """Shape (n, 3, 3)."""
        return self._tilts.view

    @property
    def travelled(self) -> FloatArray:
        """Way driven up to each, shape (n,), m."""
        return self._travelled.view

    @property
    def mapped(self) -> NDArray[np.bool_]:
        """Whether each has touches in the map, shape (n,)."""
        return self._mapped.view
