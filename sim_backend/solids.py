"""Solid objects of a world: box, cylinder and sphere, with the height of their upper surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]

#: Height of a solid where a vertical line misses it.
NOWHERE = -np.inf


@dataclass(frozen=True, slots=True)
class Solid:
    """A box, a cylinder or a sphere.

    Attributes:
        name: what it is called.
        shape: `box`, `cylinder` (its axis is its own z) or `sphere`; names of MuJoCo's geoms too.
        size: box: half lengths along its own axes; cylinder: radius, half length; sphere: radius; m.
        centre: position of the centre, shape (3,), m.
        R: rotation, own frame to the world's, shape (3, 3).
    """

    name: str
    shape: str
    size: tuple[float, ...]
    centre: FloatArray
    R: FloatArray

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the upper surface where the vertical line through (x, y) meets the solid, else -inf; m."""
        # The line in the solid's own frame: origin + t * direction, t the height above the centre.
        offset = np.stack([x - self.centre[0], y - self.centre[1], np.zeros_like(x)], axis=-1)
        origin = offset @ self.R
        direction = self.R[2]
        intersect = {"box": self._box, "cylinder": self._cylinder, "sphere": self._sphere}[self.shape]
        height: FloatArray = intersect(origin, direction) + self.centre[2]
        return height

    def half_height(self) -> float:
        """Height of the highest point above the centre, m."""
        up = self.R[2]
        if self.shape == "box":
            return float(np.abs(up) @ np.asarray(self.size))
        if self.shape == "cylinder":
            return self.size[0] * float(np.hypot(up[0], up[1])) + self.size[1] * abs(float(up[2]))
        return self.size[0]

    def quaternion_wxyz(self) -> FloatArray:
        """The rotation as MuJoCo writes it, shape (4,)."""
        return np.roll(Rotation.from_matrix(self.R).as_quat(), 1)

    def _box(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        enter, leave = _slabs(origin, direction, np.asarray(self.size))
        return np.where(enter <= leave, leave, NOWHERE)

    def _cylinder(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        radius, half = self.size
        enter, leave = _slabs(origin[..., 2:], direction[2:], np.array([half]))
        a = direction[0] ** 2 + direction[1] ** 2
        square = origin[..., 0] ** 2 + origin[..., 1] ** 2 - radius**2
        if a < 1e-12:
            return np.where(square <= 0.0, leave, NOWHERE)
        b = origin[..., 0] * direction[0] + origin[..., 1] * direction[1]
        root = b**2 - a * square
        reach = np.sqrt(np.maximum(root, 0.0))
        enter = np.maximum(enter, (-b - reach) / a)
        leave = np.minimum(leave, (-b + reach) / a)
        return np.where((root >= 0.0) & (enter <= leave), leave, NOWHERE)

    def _sphere(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        b = origin @ direction
        root = b**2 - (origin**2).sum(axis=-1) + self.size[0] ** 2
        return np.where(root >= 0.0, -b + np.sqrt(np.maximum(root, 0.0)), NOWHERE)


def _slabs(origin: FloatArray, direction: FloatArray, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where lines enter and leave the slabs |coordinate| <= half; enter > leave where they miss."""
    enter = np.full(origin.shape[:-1], -np.inf)
    leave = np.full(origin.shape[:-1], np.inf)
    for axis in range(len(half)):
        if abs(direction[axis]) < 1e-12:
            outside = np.abs(origin[..., axis]) > half[axis]
            enter = np.where(outside, np.inf, enter)
            continue
        a = (-half[axis] - origin[..., axis]) / direction[axis]
        b = (half[axis] - origin[..., axis]) / direction[axis]
        enter = np.maximum(enter, np.minimum(a, b))
        leave = np.minimum(leave, np.maximum(a, b))
    return enter, leave
