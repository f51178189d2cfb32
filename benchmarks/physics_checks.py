"""How right the physics is: whiskers against formulas, sinking in every world, agreement of the two engines.

Usage: python -m benchmarks.physics_checks [--seconds S]
"""

from __future__ import annotations

import argparse
from itertools import pairwise

import mujoco
import numpy as np
from scipy.optimize import brentq

from robominer_slam import layout as layouts
from sim_backend import world as worlds
from sim_backend.base_motion import LevelGrid, TouchDown
from sim_backend.engines import base_motion_on, build_engine
from sim_backend.ground import HeightField
from sim_backend.physics import TIME_STEP, PhysicsEngine
from sim_backend.sinking import depth_along_rods
from sim_backend.waypoints import WaypointPath
from sim_backend.whisker_model import JOINTS, WhiskerMechanics
from sim_backend.world import World

INTERVAL = 0.04
LENGTH, GRAVITY = 0.15, 9.81
ROD = WhiskerMechanics()
WORLDS = ("thesis", "flat", "corridor", "random:1", "random:2", "random:3", "random:4", "flooded", "tunnel", "mine")


def hanging_free(frame_interval: float) -> PhysicsEngine:
    """The thesis's array high above flat ground, not moving."""
    deep = World("deep", HeightField((-2.0, -2.0), 1.0, np.full((5, 5), -1.0)), (), {})
    motion = LevelGrid(WaypointPath([[0.0, 0.0, 0.0]]), TouchDown(height=0.0, run_up=0.0))
    grid = layouts.thesis_grid()
    return PhysicsEngine(
        deep, grid, motion, read_offset=np.zeros(grid.count), frame_interval=frame_interval, settle_time=0.0
    )


def deflection_error(force: float) -> float:
    """Relative error of the angle to which a horizontal force at the tip, N, bends a whisker."""
    engine = hanging_free(INTERVAL)
    body = engine.model.geom_bodyid[mujoco.mj_name2id(engine.model, mujoco.mjtObj.mjOBJ_GEOM, "whisker10")]
    push = np.array([force, 0.0, 0.0])
    for _ in range(60):
        reading = engine.read()
        tip = engine.tips()[10]
        engine.data.xfrc_applied[body] = [*push, *np.cross(tip - engine.data.xipos[body], push)]
    weight = ROD.mass * GRAVITY * LENGTH / 2.0
    expected = brentq(lambda phi: ROD.stiffness * phi + weight * np.sin(phi) - force * LENGTH * np.cos(phi), 0.0, 1.5)
    return float(reading.inclination[10]) / expected - 1.0


def oscillation_error() -> tuple[float, float]:
    """Relative errors of frequency and logarithmic decrement of a free whisker."""
    engine = hanging_free(TIME_STEP)
    engine.data.qpos.reshape(-1, 9)[5, 7] = 0.1
    angle = np.array([engine.read().hinge[5, 0] for _ in range(160)])
    stiffness, inertia = ROD.stiffness + ROD.mass * GRAVITY * LENGTH / 2.0, ROD.inertia(LENGTH)
    zeta = ROD.damping(LENGTH) / (2.0 * np.sqrt(inertia * stiffness))
    damped = np.sqrt(stiffness / inertia) * np.sqrt(1.0 - zeta**2)
    crossings = np.flatnonzero(np.diff(np.sign(angle)))[:3]
    exact = crossings + angle[crossings] / (angle[crossings] - angle[crossings + 1])
    frequency = np.pi / (np.diff(exact).mean() * TIME_STEP)
    swings = [np.abs(angle[a:b]).max() for a, b in pairwise(crossings)]
    decrement = 2.0 * np.log(swings[0] / swings[1]) / (2.0 * np.pi * zeta / np.sqrt(1.0 - zeta**2))
    return float(frequency / damped) - 1.0, float(decrement) - 1.0


def sinking_and_agreement(name: str, seconds: float, joint: str = "default") -> tuple[float, float, float]:
    """Median and 95 % of the depth of touching rods, and median distance of the engines' tips; mm."""
    world = worlds.load(name)
    layout = layouts.BUILT_IN[world.layout]()
    motion = base_motion_on(world, WaypointPath(world.scenario(1)))
    physics, geometry = (
        build_engine(engine, world, layout, motion, read_offset=np.zeros(layout.count), interval=INTERVAL, joint=joint)
        for engine in ("physics", "quasi-static")
    )
    depth, apart = [], []
    for _ in range(round(seconds / INTERVAL)):
        tips = physics.tips()  # before the reading: where the rods are as it begins
        reading = physics.read()
        geometry.read()
        apart.append(np.linalg.norm(tips - geometry.tips(), axis=1))
        time = np.full(layout.count, reading.time)
        depth.append(depth_along_rods(world, layout, motion, time, reading.hinge, ROD.radius)[0][reading.contact])
    median, most = 1e3 * np.percentile(np.concatenate(depth), [50.0, 95.0])
    return float(median), float(most), 1e3 * float(np.median(apart))


def print_table(seconds: float) -> None:
    """Measure everything and print it as a Markdown table."""
    print("| physics check | figure |\n|---|---|")
    for force in (0.1, 0.4, 0.9):
        print(f"| deflection under {force} N at the tip, error | {100 * deflection_error(force):.2f} % |")
    frequency, decrement = oscillation_error()
    print(f"| free whisker, frequency error | {100 * frequency:.1f} % |")
    print(f"| free whisker, decrement error | {100 * decrement:.1f} % |\n")
    print("| world | joint | sinking median | 95 % | engines apart, median |\n|---|---|---|---|---|")
    for name, joint in (*((name, "default") for name in WORLDS), *(("thesis", joint) for joint in list(JOINTS)[1:])):
        median, most, apart = sinking_and_agreement(name, seconds, joint)
        print(f"| {name} | {joint} | {median:.2f} mm | {most:.2f} mm | {apart:.2f} mm |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="simulated time per world")
    print_table(parser.parse_args().seconds)
