"""The simulated robot: a scenario driven through a world, as one time-ordered sequence of sensor events."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robominer_slam import layout as layouts
from robominer_slam.layout import WhiskerLayout
from sim_backend import world as worlds
from sim_backend.base_motion import BaseMotion, BaseStates
from sim_backend.engines import ENGINES, base_motion_on, build_engine
from sim_backend.events import EncoderEvent, Event, ImuEvent, OdometryEvent, TruthEvent, WhiskerEvent
from sim_backend.extendable_path import ExtendablePath
from sim_backend.hall_drift import DriftSettings, HallDrift
from sim_backend.imu import Imu, ImuSettings
from sim_backend.magnet import HallArray
from sim_backend.odometry import BiasedOdometry, OdometrySettings, mean_body_velocity
from sim_backend.physics import Engine
from sim_backend.random_streams import stream
from sim_backend.screws import ScrewEncoders, ScrewSettings
from sim_backend.waypoints import DriveSettings
from sim_backend.world import World

FloatArray = NDArray[np.float64]
NANOSECONDS = 1_000_000_000
#: Frames for which the sensors are computed at once: numpy is slow on few samples.
BLOCK = 25
#: The same where a frame takes the engine milliseconds: a live robot must not wait for a whole second's frames.
PHYSICS_BLOCK = 5


@dataclass(frozen=True, slots=True)
class RobotSettings:
    """Rates, seeds and grades of the simulated robot.

    Attributes:
        seed: of the sensors: tolerances, biases, noise, slip.
        odometry_seed: of the ready-made odometry alone.
        frame_interval_us: time between two whisker frames, us.
        sensor_period_us: time between two sensors of a frame, us.
        joint: the whiskers' joints, one of `whisker_model.JOINTS`.
        max_time: where to cut the drive short, s; None drives to the end.
        drive, imu, screws, odometry, drift: settings of the parts.
    """

    seed: int = 1
    odometry_seed: int = 0
    frame_interval_us: int = 40_000
    sensor_period_us: int = 600
    joint: str = "default"
    max_time: float | None = None
    drive: DriveSettings = field(default_factory=DriveSettings)
    imu: ImuSettings = field(default_factory=ImuSettings)
    screws: ScrewSettings = field(default_factory=ScrewSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    drift: DriftSettings = field(default_factory=DriftSettings)


class SimulatedRobot:
    """World, motion, whiskers and sensors joined; iterate over `events` once."""

    def __init__(
        self,
        world: World,
        layout: WhiskerLayout,
        motion: BaseMotion,
        engine: Engine,
        settings: RobotSettings,
        block: int = BLOCK,
        path: ExtendablePath | None = None,
    ) -> None:
        """Switch everything on; nothing is simulated before `events` is iterated over.

        Args:
            world, layout, motion, engine: what is driven, by what, and where.
            settings: rates, seeds and grades.
            block: frames computed at once.
            path: that the motion follows, where it may grow.
        """
        self.world, self.layout, self.motion, self.settings = world, layout, motion, settings
        self.hall = HallArray(layout, settings.seed)
        self._engine, self._block, self.path = engine, block, path
        self._hall_noise = stream(settings.seed, "hall")
        self._drift = HallDrift(settings.seed, layout.count, settings.drift)
        self._imu = Imu(settings.seed, settings.imu)
        self._screws = ScrewEncoders(settings.seed, settings.screws)
        self._odometry = BiasedOdometry(settings.odometry_seed, settings.odometry)
        # The frame's last sensor has been read one period after its reading began.
        self._frame_time_ns = 1000 * settings.sensor_period_us * layout.count

    @property
    def duration(self) -> float:
        """Simulated time from start to end, s; infinite while the robot waits for waypoints."""
        limit = self.settings.max_time
        return self.motion.duration if limit is None else min(limit, self.motion.duration)

    def events(self) -> Iterator[Event]:
        """All events, ordered by the time at which they are ready; computed a block of frames ahead."""
        interval = self.settings.frame_interval_us * 1000
        waiting: list[Event] = []
        first = 0
        while (last := self._block_end(first)) > first:
            start, end = first * interval, last * interval
            waiting += self._frames(first, last)
            waiting += self._imu_events(start, end)
            waiting += self._encoder_events(start, end)
            waiting += self._odometry_events(start, end)
            waiting.sort(key=lambda event: event.ready_ns)
            # What is ready later than the next block begins waits for that block's events.
            ready = sum(event.ready_ns < end for event in waiting)
            yield from waiting[:ready]
            waiting = waiting[ready:]
            first = last
        yield from waiting

    def _block_end(self, first: int) -> int:
        """Number of the frame before which the block that begins with `first` ends; `first` when all is over."""
        interval = self.settings.frame_interval_us * 1000
        while True:
            last = int(min(self.duration * NANOSECONDS, (first + self._block) * interval)) // interval
            if last > first or self.path is None:
                return max(last, first)
            limit = self.settings.max_time
            cut_short = limit is not None and limit * NANOSECONDS < (first + 1) * interval
            # A microsecond more than the frame that is not driven: whatever rounding does, it is over then.
            if self.path.close(math.inf if cut_short else (first + 1) * interval / NANOSECONDS + 1e-6):
                return first

    def _frames(self, first: int, last: int) -> list[Event]:
        """Truth and whiskers of the frames numbered from `first` to before `last`."""
        stamps = np.arange(first, last + 1) * (self.settings.frame_interval_us * 1000)
        base = self.motion.at(stamps / NANOSECONDS)
        readings = [self._engine.read() for _ in stamps[:-1]]
        field = self.hall.field(np.stack([reading.hinge for reading in readings]), base.R[:-1])
        field = self._drift.apply(field, self.settings.frame_interval_us * 1e-6)
        field_mT = self.hall.sample(field, self._hall_noise)
        field_mT[:, ~self.layout.present] = 0.0
        orientation = Rotation.from_matrix(base.R).as_quat()
        velocity, omega = (np.einsum("mji,mj->mi", base.R, v) for v in (base.velocity, base.omega))
        contacts = self._in_base(np.stack([reading.contact_point for reading in readings]), base)
        events: list[Event] = []
        for k, (start, reading) in enumerate(zip(stamps[:-1].tolist(), readings, strict=True)):
            events.append(TruthEvent(start, start, base.position[k], orientation[k], velocity[k], omega[k]))
            ready = start + self._frame_time_ns
            events.append(WhiskerEvent(start, ready, field_mT[k], self.layout.present, reading, contacts[k]))
        return events

    def _in_base(self, points: FloatArray, base: BaseStates) -> FloatArray:
        """Points of m frames, shape (m, n, 3), m, from the map to base_link as it was when each sensor was read.

        Args:
            points: in the map.
            base: the body at the starts of these frames and of the next; between, it moves evenly but for
                micrometres.
        """
        offset = np.arange(self.layout.count) * self.settings.sensor_period_us
        share = (offset / self.settings.frame_interval_us)[:, None]
        position = base.position[:-1, None] + share * np.diff(base.position, axis=0)[:, None]
        R = base.R[:-1, None] + share[:, :, None] * np.diff(base.R, axis=0)[:, None]
        in_base: FloatArray = ((points - position)[..., None, :] @ R)[..., 0, :]
        return in_base

    def _imu_events(self, start_ns: int, end_ns: int) -> list[Event]:
        number, stamps = _samples(start_ns, end_ns, self.settings.imu.rate)
        if not len(number):
            return []
        motion = self.motion.at(stamps / NANOSECONDS)
        gyro, acceleration = self._imu.sample(motion)
        gravity = self._imu.gravity(motion)
        return [
            ImuEvent(int(t), int(t), w, f, g) for t, w, f, g in zip(stamps, gyro, acceleration, gravity, strict=True)
        ]

    def _encoder_events(self, start_ns: int, end_ns: int) -> list[Event]:
        rate = self.settings.screws.rate
        number, stamps = _samples(start_ns, end_ns, rate)
        if not len(number):
            return []
        # An angle is what has turned up to its reading; at the first one, nothing has.
        motion = self.motion.at(np.concatenate([[max(number[0] - 1, 0)], number]) / rate)
        velocity = mean_body_velocity(motion, 1.0 / rate)
        angles = self._screws.advance(motion.position[:-1, :2], velocity)
        ticks = self._screws.ticks(angles)
        radians = ticks * (2.0 * np.pi / self.settings.screws.ticks_per_turn)
        return [EncoderEvent(int(t), int(t), c, a) for t, c, a in zip(stamps, ticks, radians, strict=True)]

    def _odometry_events(self, start_ns: int, end_ns: int) -> list[Event]:
        rate = self.settings.odometry.rate
        number, stamps = _samples(start_ns, end_ns, rate)
        stamps = stamps[number > 0]  # the first interval ends one period after the start
        number = number[number > 0]
        if not len(number):
            return []
        motion = self.motion.at(np.concatenate([[number[0] - 1], number]) / rate)
        velocity = self._odometry.sample(motion)
        return [OdometryEvent(int(t), int(t), v) for t, v in zip(stamps, velocity, strict=True)]


def _samples(start_ns: int, end_ns: int, rate: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers and times in ns of the samples of a rate in Hz that fall into [start, end)."""
    period = NANOSECONDS / rate
    number = np.arange(int(start_ns / period) - 1, int(end_ns / period) + 2, dtype=np.int64)
    stamps = np.rint(number * period).astype(np.int64)
    inside = (stamps >= start_ns) & (stamps < end_ns)
    return number[inside], stamps[inside]


def build_robot(
    world_name: str = "thesis",
    scenario: int = 1,
    engine: str = "physics",
    settings: RobotSettings | None = None,
) -> SimulatedRobot:
    """The thesis's robot in a world, about to drive a scenario; in scenario 0 it waits for waypoints.

    Raises:
        WorldError: no such world or scenario, or the engine cannot do this world.
        ValueError: no such engine.
    """
    if engine not in ENGINES:
        raise ValueError(f"no engine is called {engine!r}, expected one of {', '.join(ENGINES)}")
    chosen = settings or RobotSettings()
    world = worlds.load(world_name)
    layout = layouts.BUILT_IN[world.layout]()
    # More whiskers are read faster, so that a frame ends before the next.
    period = min(chosen.sensor_period_us, chosen.frame_interval_us * 96 // 100 // layout.count)
    chosen = replace(chosen, sensor_period_us=period)
    path = ExtendablePath(world.scenario(scenario), chosen.drive, waits=scenario == 0)
    motion = base_motion_on(world, path)
    array = build_engine(
        engine,
        world,
        layout,
        motion,
        read_offset=np.arange(layout.count, dtype=np.float64) * chosen.sensor_period_us * 1e-6,
        interval=chosen.frame_interval_us * 1e-6,
        joint=chosen.joint,
    )
    block = PHYSICS_BLOCK if engine == "physics" else BLOCK
    return SimulatedRobot(world, layout, motion, array, chosen, block, path)
