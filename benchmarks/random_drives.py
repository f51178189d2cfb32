"""Random drives over ground that a map knows, by the simulated robot: what relocalisation is measured with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drivers.measurement import HallFrame, ImuSample, Measurement, OdometrySample, ScrewAngles
from robominer_slam import layout as layouts
from sim_backend import world as worlds
from sim_backend.engines import base_motion_on, build_engine
from sim_backend.events import EncoderEvent, Event, ImuEvent, OdometryEvent, TruthEvent, WhiskerEvent
from sim_backend.extendable_path import ExtendablePath
from sim_backend.magnet import HallArray
from sim_backend.recorder import EPOCH_NS
from sim_backend.robot import RobotSettings, SimulatedRobot

FloatArray = NDArray[np.float64]

#: Half length and half width of the thesis's array, m.
HALF_ARRAY = (0.14, 0.24)
#: Ground within this of a touch is mapped, m.
TOUCHED = 0.04
#: Share of the array that must be over mapped ground, everywhere on the way.
MAPPED_SHARE = 0.8
#: The robot whose calibration the recordings carry.
CALIBRATED_SEED = 1


class MappedGround:
    """Where a map's touches lie, in its plane."""

    def __init__(self, touches: FloatArray) -> None:
        """Take the touches, shape (n, 3), in map, m."""
        self._tree = cKDTree(touches[:, :2])
        self.low, self.high = touches[:, :2].min(axis=0), touches[:, :2].max(axis=0)
        u, v = (np.linspace(-half, half, 7) for half in HALF_ARRAY)
        self._array = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)

    def share(self, pose: FloatArray) -> float:
        """Share of the array over mapped ground at x, y, heading."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        places = self._array @ np.array([[c, s], [-s, c]]) + pose[:2]
        return float((self._tree.query(places)[0] <= TOUCHED).mean())


def random_drive(ground: MappedGround, rng: np.random.Generator, length: float) -> FloatArray:
    """Waypoints (n, 3), x, y (m), heading (rad), of random legs over mapped ground, `length` m in all or more.

    Start and heading are drawn evenly over the mapped ground; the robot moves in any direction, and on half of the
    legs turns by up to a quarter turn on the way.
    """
    while True:
        start = np.append(rng.uniform(ground.low, ground.high), rng.uniform(-np.pi, np.pi))
        if ground.share(start) < MAPPED_SHARE:
            continue
        way, driven = [start], 0.0
        for _ in range(200):
            leg, turn = rng.uniform(0.3, 1.0), rng.uniform(-np.pi / 2, np.pi / 2) * (rng.random() < 0.5)
            direction = rng.uniform(-np.pi, np.pi)
            end = way[-1] + np.array([leg * np.cos(direction), leg * np.sin(direction), turn])
            between = way[-1] + np.linspace(0.0, 1.0, 8)[1:, None] * (end - way[-1])
            if min(ground.share(pose) for pose in between) < MAPPED_SHARE:
                continue
            way.append(end)
            driven += leg
            if driven >= length:
                return np.array(way)


def simulated_robot(world_name: str, waypoints: FloatArray, seed: int) -> SimulatedRobot:
    """The calibrated robot with other noise, about to drive waypoints through a world, quasi-static."""
    world = worlds.load(world_name)
    world = replace(world, scenarios={1: waypoints})
    layout = layouts.BUILT_IN[world.layout]()
    settings = RobotSettings(seed=seed, odometry_seed=seed)
    path = ExtendablePath(waypoints, settings.drive)
    motion = base_motion_on(world, path)
    offset = np.arange(layout.count, dtype=np.float64) * settings.sensor_period_us * 1e-6
    engine = build_engine(
        "quasi-static", world, layout, motion, read_offset=offset, interval=settings.frame_interval_us * 1e-6
    )
    robot = SimulatedRobot(world, layout, motion, engine, settings, path=path)
    robot.hall = HallArray(layout, CALIBRATED_SEED)
    return robot


def measurements(robot: SimulatedRobot) -> Iterator[tuple[str, Measurement] | TruthEvent]:
    """A drive's measurements with the names of their devices, and the truth, in the order of arrival."""
    rows, cols = robot.layout.rows, robot.layout.cols
    period_ns = 1000 * robot.settings.sensor_period_us
    for event in robot.events():
        if isinstance(event, TruthEvent):
            yield replace(event, time_ns=EPOCH_NS + event.time_ns)
        elif (measured := _measurement(event, rows, cols, period_ns)) is not None:
            yield measured


def _measurement(event: Event, rows: int, cols: int, period_ns: int) -> tuple[str, Measurement] | None:
    stamp = EPOCH_NS + event.time_ns
    match event:
        case WhiskerEvent():
            field = event.field_mT.reshape(rows, cols, 3)
            return "whiskers", HallFrame(stamp, field, event.valid.reshape(rows, cols), period_ns)
        case ImuEvent():
            return "imu", ImuSample(stamp, event.gyro, event.acceleration)
        case EncoderEvent():
            return "screws", ScrewAngles(stamp, event.angle)
        case OdometryEvent():
            return "odometry", OdometrySample(stamp, event.velocity)
    return None
