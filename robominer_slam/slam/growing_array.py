"""An array that grows at its end without being copied every time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray


class GrowingArray:
    """Rows of one shape and type; room is doubled when it runs out, so adding a row is cheap on average."""

    def __init__(self, row_shape: tuple[int, ...], dtype: DTypeLike) -> None:
        """Start empty; one row has `row_shape`."""
        self._buffer: NDArray[Any] = np.empty((16, *row_shape), dtype=dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def view(self) -> NDArray[Any]:
        """The rows, shape (n, *row_shape): writable, and valid until rows are added."""
        return self._buffer[: self._count]

    def extend(self, rows: ArrayLike) -> None:
        """Add rows, shape (k, *row_shape)."""
        added = np.asarray(rows, dtype=self._buffer.dtype)
        end = self._count + added.shape[0]
        if end > self._buffer.shape[0]:
            grown = np.empty((max(end, 2 * self._buffer.shape[0]), *self._buffer.shape[1:]), self._buffer.dtype)
            grown[: self._count] = self.view
            self._buffer = grown
        self._buffer[self._count : end] = added
        self._count = end

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Drop the rows where `kept`, shape (n,), is False; the others close up in their order."""
        rows = self.view[kept]
        self._count = len(rows)
        self._buffer[: self._count] = rows
        if self._buffer.shape[0] > 4 * max(self._count, 16):
            self._buffer = self._buffer[: 2 * max(self._count, 16)].copy()
