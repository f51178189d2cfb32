"""The robot's map as the page's scene takes it: points by chunk in their keyframes' frames, poses by slot.

Every keyframe has a slot, in the order in which it came. Points stay where they are when the graph is corrected:
the page moves them with their keyframe's pose, so that a correction costs 32 bytes a keyframe and no points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.publishing.map_state import MapState, StreamKeyframe

FloatArray = NDArray[np.float64]

#: Keyframes to a chunk: one draw call each, and what is sent again when one of them gets other points.
CHUNK = 128
#: Of the heights, which the colours run from and to: single wrong touches must not bleach the map.
HEIGHT_PERCENTILES = (1.0, 99.0)
#: Points are drawn as large as the ground between them: the map stream tells one of each cell of this size, m.
_CELL = 0.03
#: Dense maps are drawn with points of no less than this share of it.
_FINEST = 3.0
#: Points of each keyframe that stand for all of it in the range of heights.
_SAMPLED = 4


class MapModel:
    """Takes states of the map stream; the caller holds a lock.

    Attributes:
        map_id, version: of the state taken last.
        generation: grows when another map begins: who follows then starts anew.
        count: slots in use, of keyframes that are there and of those that have gone.
        poses: by slot: x y z (m), 1 if it is there, qx qy qz qw; shape (capacity, 8).
        pose_revision: by slot: the revision in which its pose changed last.
        chunk_revision: by chunk: the revision in which its points changed last.
        revision: of the last change.
        points: in the whole map.
        closures: slots of each loop closure's ends, shape (m, 2).
    """

    def __init__(self) -> None:
        self.map_id = self.version = self.generation = self.revision = 0
        self._clear()

    def _clear(self) -> None:
        self.count = self.points = 0
        self.poses = np.zeros((CHUNK, 8), dtype=np.float32)
        self.pose_revision = np.zeros(CHUNK, dtype=np.int64)
        self.chunk_revision: list[int] = []
        self.closures: NDArray[np.int32] = np.zeros((0, 2), dtype=np.int32)
        self.closures_revision = 0
        self._slots: dict[int, int] = {}
        self._keyframes: list[StreamKeyframe | None] = []
        self._stamps = np.zeros(CHUNK, dtype=np.int64)
        self._sample = np.full((CHUNK, _SAMPLED, 3), np.nan, dtype=np.float32)
        self._cells = np.zeros(CHUNK, dtype=np.int64)
        self._reach: list[float] = []
        self._generator = np.random.default_rng(0)

    def update(self, state: MapState) -> None:
        """Take the newest state of the map."""
        self.revision += 1
        if state.map_id != self.map_id or state.version < self.version:
            self.generation += 1
            self._clear()
        self.map_id, self.version = state.map_id, state.version
        for key in [key for key in self._slots if key not in state.keyframes]:
            slot = self._slots.pop(key)
            self._set_points(slot, None)
            self.poses[slot, 3] = 0.0
            self.pose_revision[slot] = self.revision
        for key, keyframe in state.keyframes.items():
            slot = self._slots.get(key, -1)
            if slot < 0:
                slot = self._new_slot(key)
            known = self._keyframes[slot]
            if known is keyframe:
                continue
            if known is None or known.points_digest != keyframe.points_digest:
                self._set_points(slot, keyframe)
            if known is None or known.pose != keyframe.pose:
                vector = keyframe.vector7()
                self.poses[slot] = (*vector[:3], 1.0, *vector[3:])
                self.pose_revision[slot] = self.revision
            self._keyframes[slot] = keyframe
            self._stamps[slot] = keyframe.stamp_ns

    def set_closures(self, pairs: list[tuple[int, int]]) -> None:
        """Loop closures, as ids of keyframes; those of keyframes that are not known here are left out."""
        known = [(self._slots[i], self._slots[j]) for i, j in pairs if i in self._slots and j in self._slots]
        closures = np.array(known, dtype=np.int32).reshape(-1, 2)
        if not np.array_equal(closures, self.closures):
            self.revision += 1
            self.closures, self.closures_revision = closures, self.revision

    def chunk(self, index: int) -> NDArray[np.int16]:
        """Points of a chunk, shape (m, 4): x y z (POINT_UNIT_M, in the keyframe's frame), slot in the chunk.

        In an order that makes any first part of them a fair sample of the whole.
        """
        parts = []
        for k, keyframe in enumerate(self._keyframes[index * CHUNK : (index + 1) * CHUNK]):
            if keyframe is not None and len(keyframe.points):
                slot = np.full((len(keyframe.points), 1), k, dtype=np.int16)
                parts.append(np.hstack([keyframe.points, slot]))
        if not parts:
            return np.zeros((0, 4), dtype=np.int16)
        joined: NDArray[np.int16] = np.concatenate(parts)
        return joined[self._generator.permutation(len(joined))]

    def bounds(self) -> FloatArray:
        """Of each chunk, a sphere around its points in map: x y z, radius (m); shape (chunks, 4)."""
        spheres = np.zeros((len(self.chunk_revision), 4))
        for index in range(len(spheres)):
            slots = np.arange(index * CHUNK, min((index + 1) * CHUNK, self.count))
            slots = slots[self.poses[slots, 3] > 0.0]
            if len(slots):
                low, high = self.poses[slots, :3].min(axis=0), self.poses[slots, :3].max(axis=0)
                radius = 0.5 * float(np.linalg.norm(high - low)) + self._reach[index]
                spheres[index] = (*(0.5 * (low + high)), radius)
        return spheres

    def height_range(self) -> tuple[float, float]:
        """Heights between which the colours run, m."""
        poses, sample = self.poses[: self.count], self._sample[: self.count]
        x, y, z, w = poses[:, 4:].T
        down = np.column_stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
        heights = (poses[:, 2, None] + np.einsum("nk,nmk->nm", down, sample))[poses[:, 3] > 0.0]
        heights = heights[np.isfinite(heights)]
        if not len(heights):
            return 0.0, 1.0
        low, high = (float(value) for value in np.percentile(heights, HEIGHT_PERCENTILES))
        return low, max(high, low + 0.02)

    def spacing(self) -> float:
        """How far neighbouring points are from each other, as far as it is to be drawn, m."""
        cells = int(self._cells[: self.count].sum())
        to_a_cell = max(self.points / cells, 1.0) if cells else 1.0
        return _CELL / min(math.sqrt(to_a_cell), _FINEST)

    def cloud(self) -> FloatArray:
        """All points in map, shape (m, 3), m."""
        parts = [
            geometry.transform_points(geometry.from_vector7(keyframe.vector7()), keyframe.points_m())
            for keyframe in self._keyframes
            if keyframe is not None and len(keyframe.points)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3))

    def trajectory(self) -> list[tuple[int, FloatArray]]:
        """Stamps (UNIX ns) and poses (7,) of the keyframes that are there."""
        return [(keyframe.stamp_ns, keyframe.vector7()) for keyframe in self._keyframes if keyframe is not None]

    def slots_until(self, stamp_ns: int) -> int:
        """How many slots, from the first, belong to keyframes up to a time."""
        return int(np.searchsorted(np.maximum.accumulate(self._stamps[: self.count]), stamp_ns, side="right"))

    def _new_slot(self, key: int) -> int:
        slot = self.count
        self.count += 1
        self._slots[key] = slot
        self._keyframes.append(None)
        if self.count > len(self.poses):
            self.poses = np.concatenate([self.poses, np.zeros_like(self.poses)])
            self.pose_revision = np.concatenate([self.pose_revision, np.zeros_like(self.pose_revision)])
            self._stamps = np.concatenate([self._stamps, np.zeros_like(self._stamps)])
            self._cells = np.concatenate([self._cells, np.zeros_like(self._cells)])
            self._sample = np.concatenate([self._sample, np.full_like(self._sample, np.nan)])
        if slot // CHUNK >= len(self.chunk_revision):
            self.chunk_revision.append(self.revision)
            self._reach.append(0.0)
        return slot

    def _set_points(self, slot: int, keyframe: StreamKeyframe | None) -> None:
        known = self._keyframes[slot]
        self.points += (0 if keyframe is None else len(keyframe.points)) - (0 if known is None else len(known.points))
        self._sample[slot], self._cells[slot] = np.nan, 0
        if keyframe is None:
            self._keyframes[slot] = None
        elif len(keyframe.points):
            points = keyframe.points_m()
            self._cells[slot] = len(np.unique(np.floor(points[:, :2] / _CELL) @ [1.0, 1e5]))
            chosen = points[np.linspace(0, len(points) - 1, min(_SAMPLED, len(points))).astype(np.intp)]
            self._sample[slot, : len(chosen)] = chosen
            reach = float(np.sqrt(np.square(points).sum(axis=1).max()))
            self._reach[slot // CHUNK] = max(self._reach[slot // CHUNK], reach)
        self.chunk_revision[slot // CHUNK] = self.revision
