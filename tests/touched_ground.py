"""Grounds for the tests of matching: heights as functions of x and y, and touches on them with noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robominer_slam.configuration.robust_slam_section import SurfaceSection
from robominer_slam.slam.surface import SurfaceModel

SECTION = SurfaceSection()
MODEL = SurfaceModel.of(SECTION)
#: Of a touch's height, m.
NOISE = 0.001

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]


def rough(seed: int = 0, relief: float = 0.012) -> Height:
    """Waves of 0.3 to 1 m in all directions; `relief` is the standard deviation, m."""
    rng = np.random.default_rng(seed)
    k, direction, phase = rng.uniform(6.0, 21.0, 24), rng.uniform(0, 2 * np.pi, 24), rng.uniform(0, 2 * np.pi, 24)
    kx, ky = k * np.cos(direction), k * np.sin(direction)

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        waves = np.cos(np.multiply.outer(x, kx) + np.multiply.outer(y, ky) + phase)
        return relief * np.sqrt(2.0 / 24) * waves.sum(axis=-1)

    return height


def flat(x: np.ndarray, _: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def corridor(_: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Ridges along x."""
    return 0.02 * np.cos(15.0 * y) + 0.01 * np.cos(27.0 * y + 1.0)


def repeated(period: float) -> Height:
    """The same rough metres again and again along x."""
    pattern = rough(5)
    return lambda x, y: pattern(np.mod(x, period), y)


def touches(
    height: Height, rng: np.random.Generator, count: int, half: tuple[float, float], pose=(0.0, 0.0, 0.0),
    noise: float = NOISE,
) -> np.ndarray:  # fmt: skip
    """Touches in the level frame at `pose` (x, y, heading), all over a rectangle around it, shape (count, 3)."""
    u, v = rng.uniform(-half[0], half[0], count), rng.uniform(-half[1], half[1], count)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    z = height(pose[0] + c * u - s * v, pose[1] + s * u + c * v)
    return np.column_stack([u, v, z + rng.normal(0, noise, count)])
