"""How deep rods are in the true surface, along all of their length: what every engine must be checked for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout
from sim_backend.base_motion import BaseMotion
from sim_backend.physics import rod_direction
from sim_backend.scene import World
from sim_backend.solids import Solid
from sim_backend.touch_surface import SmoothHeight

FloatArray = NDArray[np.float64]

#: Places along a rod, as shares of the way from its joint to the centre of its rounded end: 4 mm apart.
PLACES = np.linspace(0.15, 1.0, 32)


def depth_along_rods(
    world: World, layout: WhiskerLayout, motion: BaseMotion, time: FloatArray, hinge: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray]:
    """Depth of rods in ground, walls and objects.

    Args:
        world, layout, motion: what is simulated.
        time: when each rod was read, shape (n,), s.
        hinge: its angles then, shape (n, 2), rad.
        radius: of the rods, m.

    Returns:
        Depth of each rod's deepest place, shape (n,), m, negative where it is free, and that place's distance from
        the joint, shape (n,), m.
    """
    base = motion.at(time)
    mount = base.position + np.einsum("nij,nj->ni", base.R, layout.p_base)
    direction = np.einsum("nij,njk,nk->ni", base.R, layout.R_base_whisker, rod_direction(hinge))
    arm = PLACES[:, None] * (layout.length - radius)
    p = (mount + arm[:, :, None] * direction).reshape(-1, 3)
    surface = world.walls or SmoothHeight(world.ground)
    gap, gradient = surface.gap(p.T)
    distance = gap / np.sqrt(np.square(gradient).sum(axis=0))
    for solid in world.solids:
        distance = np.minimum(distance, distance_from(solid, p))
    depth = radius - distance.reshape(arm.shape)
    deepest = depth.argmax(axis=0)
    each = np.arange(layout.count)
    return depth[deepest, each], arm[deepest, each]


def distance_from(solid: Solid, p: FloatArray) -> FloatArray:
    """Distance of points, shape (n, 3), m, from the solid's surface, negative inside, shape (n,), m."""
    q = (p - solid.centre) @ solid.R
    if solid.shape == "sphere":
        away: FloatArray = np.sqrt(np.square(q).sum(axis=1)) - solid.size[0]
        return away
    if solid.shape == "cylinder":
        radius, half = solid.size
        beyond = np.stack([np.hypot(q[:, 0], q[:, 1]) - radius, np.abs(q[:, 2]) - half], axis=1)
    else:
        beyond = np.abs(q) - np.asarray(solid.size)
    outside = np.sqrt(np.square(np.maximum(beyond, 0.0)).sum(axis=1))
    distance: FloatArray = outside + np.minimum(beyond.max(axis=1), 0.0)
    return distance
