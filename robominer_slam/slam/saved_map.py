"""A map as it was saved: what a new session starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.keyframe import GraphEdge, Keyframe

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SavedMap:
    """Keyframes, their poses in map, and the edges between them.

    Attributes:
        keyframes: in the order of their ids; ids may have gaps where a keyframe was lost.
        poses: of each in map, shape (n, 4, 4).
        edges: of the graph; all of them between these keyframes.
        name: for messages.
    """

    keyframes: tuple[Keyframe, ...]
    poses: FloatArray
    edges: Sequence[GraphEdge]
    name: str

    @property
    def ids(self) -> tuple[int, ...]:
        """Of the keyframes."""
        return tuple(k.id for k in self.keyframes)

    @property
    def next_id(self) -> int:
        """What a session that goes on calls its first keyframe."""
        return self.keyframes[-1].id + 1 if self.keyframes else 0
