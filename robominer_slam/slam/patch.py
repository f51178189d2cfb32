"""Touches of a keyframe as matches need them: level, thinned, those of the floor apart from those of walls."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.composite_scan import voxel_filter
from robominer_slam.slam.keyframe import Keyframe

FloatArray = NDArray[np.float64]


def no_touches() -> FloatArray:
    """Touches of shape (0, 3)."""
    return np.zeros((0, 3))


@dataclass(frozen=True, slots=True)
class Patch:
    """Touches in the level frame of the keyframe that they were gathered at.

    Attributes:
        points: of the floor, shape (m, 3), m.
        travelled: way driven up to it, m.
        walls: touches of whiskers that do not point down, shape (n, 3), m.
    """

    points: FloatArray
    travelled: float
    walls: FloatArray = field(default_factory=no_touches)

    def __len__(self) -> int:
        return len(self.points) + len(self.walls)


def patch_of(keyframe: Keyframe, tilt: FloatArray, voxel: float) -> Patch:
    """A keyframe's touches.

    Args:
        keyframe: with its touches in base_link.
        tilt: rotation from base_link into its level frame, shape (3, 3).
        voxel: touches closer than this become one, m.
    """
    floor = voxel_filter(keyframe.floor_points @ tilt.T, voxel)
    return Patch(floor, keyframe.travelled, voxel_filter(keyframe.wall_points @ tilt.T, voxel))
