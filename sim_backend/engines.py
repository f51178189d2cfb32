"""The engines by name, and what each can do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout
from sim_backend.base_motion import BaseMotion, FollowGround, LevelGrid
from sim_backend.physics import Engine, PhysicsEngine
from sim_backend.quasi_static import QuasiStaticEngine
from sim_backend.scene import World, WorldError
from sim_backend.touch_surface import SampledHeight
from sim_backend.waypoints import WaypointPath

FloatArray = NDArray[np.float64]

ENGINES = ("physics", "quasi-static")


def build_engine(
    name: str, world: World, layout: WhiskerLayout, motion: BaseMotion, *, read_offset: FloatArray, interval: float
) -> Engine:
    """An engine, its whiskers already on the ground.

    Args:
        name: one of ENGINES.
        world, layout, motion: what it simulates.
        read_offset: when each sensor is read after the frame's start, shape (n,), s, below `interval`.
        interval: time from frame to frame, s.

    Raises:
        ValueError: no such engine.
        WorldError: the physics engine is asked for a world with walls.
    """
    if name not in ENGINES:
        raise ValueError(f"no engine is called {name!r}, expected one of {', '.join(ENGINES)}")
    if name == "physics":
        if world.walls is not None:
            raise WorldError(f"world {world.name!r} has walls, which the physics engine lacks: use quasi-static")
        return PhysicsEngine(world, layout, motion, read_offset=read_offset, frame_interval=interval)
    surface = world.walls or SampledHeight(world.height, world.ground.extent)
    return QuasiStaticEngine(surface, layout, motion, read_offset=read_offset, frame_interval=interval)


def base_motion_on(world: World, path: WaypointPath) -> BaseMotion:
    """The thesis's level grid, or a body that follows the floor where the world has one."""
    if world.floor is None:
        return LevelGrid(path)
    start = np.zeros(1)
    return FollowGround(path, world.floor, ride_height=-float(world.floor(start, start)[0]))
