"""How many times faster than real time the simulator runs, and how right its physics is.

Usage: python -m benchmarks.simulator [--seconds S]

Prints two Markdown tables. Speed: `tips` is the engine alone, read after read; `all sensors` is every event of the
robot (Hall fields, IMU, screws, odometry, truth), as a recording gets them; processor time of one core, each figure
the best of three. Physics checks: a bent and a swinging whisker against formulas, sinking along the rods, and how far
the tips of the two engines are apart (`benchmarks.physics_checks`).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from benchmarks import physics_checks
from robominer_slam import layout as layouts
from sim_backend import world as worlds
from sim_backend.engines import base_motion_on, build_engine
from sim_backend.physics import Engine
from sim_backend.robot import RobotSettings, build_robot
from sim_backend.waypoints import WaypointPath

INTERVAL = 0.04
REPEATS = 3
CASES = (
    ("thesis", "physics"),
    ("thesis", "quasi-static"),
    ("random:1", "physics"),
    ("random:1", "quasi-static"),
    ("tunnel", "physics"),
    ("tunnel", "quasi-static"),
    ("mine", "physics"),
    ("mine", "quasi-static"),
)


def build(world_name: str, engine: str) -> Engine:
    """An engine at the start of scenario 1."""
    world = worlds.load(world_name)
    layout = layouts.BUILT_IN[world.layout]()
    motion = base_motion_on(world, WaypointPath(world.scenario(1)))
    offset = np.arange(layout.count, dtype=np.float64) * (0.96 * INTERVAL / layout.count)
    return build_engine(engine, world, layout, motion, read_offset=offset, interval=INTERVAL)


def tips_factor(world_name: str, engine: str, seconds: float) -> float:
    """Real-time factor of the engine alone; building it does not count."""
    array = build(world_name, engine)
    return _factor(seconds, lambda: [array.read() for _ in range(round(seconds / INTERVAL))])


def robot_factor(world_name: str, engine: str, seconds: float) -> float:
    """Real-time factor of all events; building the robot does not count."""
    robot = build_robot(world_name, engine=engine, settings=RobotSettings(max_time=seconds))
    return _factor(seconds, lambda: sum(1 for _ in robot.events()))


def _factor(seconds: float, run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return seconds / (time.process_time() - start)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="simulated time per measurement")
    seconds = parser.parse_args().seconds
    print("| world | layout | engine | tips | all sensors |\n|---|---|---|---|---|")
    for world_name, engine in CASES:
        layout = worlds.load(world_name).layout
        tips = max(tips_factor(world_name, engine, seconds) for _ in range(REPEATS))
        everything = max(robot_factor(world_name, engine, seconds) for _ in range(REPEATS))
        print(f"| {world_name} | {layout} | {engine} | {tips:.1f} | {everything:.1f} |", flush=True)
    print()
    physics_checks.print_table(seconds)


if __name__ == "__main__":
    main()
