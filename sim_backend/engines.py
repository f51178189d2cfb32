"""The engines by name, and what each can do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout
from sim_backend.base_motion import BaseMotion, FollowGround, LevelGrid
from sim_backend.physics import Engine, PhysicsEngine
from sim_backend.quasi_static import QuasiStaticEngine
from sim_backend.scene import World
from sim_backend.touch_surface import SampledHeight
from sim_backend.waypoints import WaypointPath
from sim_backend.whisker_model import JOINTS

FloatArray = NDArray[np.float64]

ENGINES = ("physics", "quasi-static")


def build_engine(
    name: str,
    world: World,
    layout: WhiskerLayout,
    motion: BaseMotion,
    *,
    read_offset: FloatArray,
    interval: float,
    joint: str = "default",
) -> Engine:
    """An engine, its whiskers already on the ground.

    Args:
        name: one of ENGINES.
        world, layout, motion: what it simulates.
        read_offset: when each sensor is read after the frame's start, shape (n,), s, below `interval`.
        interval: time from frame to frame, s.
        joint: the whiskers' joints, one of `whisker_model.JOINTS`.

    Raises:
        ValueError: no such engine or joint.
    """
    if name not in ENGINES:
        raise ValueError(f"no engine is called {name!r}, expected one of {', '.join(ENGINES)}")
    if joint not in JOINTS:
        raise ValueError(f"no joint is called {joint!r}, expected one of {', '.join(JOINTS)}")
    rod = JOINTS[joint]
    if name == "physics":
        return PhysicsEngine(world, layout, motion, read_offset=read_offset, frame_interval=interval, mechanics=rod)
    surface = world.walls or SampledHeight(world.height, world.ground.extent)
    return QuasiStaticEngine(
        surface, layout, motion, read_offset=read_offset, frame_interval=interval, mechanics=rod, water=world.water
    )


def base_motion_on(world: World, path: WaypointPath) -> BaseMotion:
    """The thesis's level grid, or a body that follows the floor where the world has one."""
    if world.floor is None:
        return LevelGrid(path)
    start = np.zeros(1)
    return FollowGround(path, world.floor, ride_height=-float(world.floor(start, start)[0]))
