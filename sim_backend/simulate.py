"""One simulated drive, on serial devices or into a recording, with the files that belong to it."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.recording_reader import Recording
from robominer_slam import layout as layouts
from robominer_slam.layout import WhiskerLayout
from sim_backend.configuration_writer import (
    CALIBRATION,
    CONFIGURATION,
    ROBOT_ID,
    USED_BY_SOURCE,
    Port,
    configuration_text,
    framed_port,
    write_calibration,
)
from sim_backend.control_socket import ControlSocket
from sim_backend.device_protocols import parse_protocols
from sim_backend.device_server import DeviceServer, StartTime
from sim_backend.events import Event, TruthEvent
from sim_backend.fault_schedule import FaultFileError, FaultSchedule, faults_from_option
from sim_backend.recorded_drive import RecordedDriveError, events_of
from sim_backend.recorder import record
from sim_backend.robot import RobotSettings, SimulatedRobot, build_robot
from sim_backend.sensor_faults import SensorFaults
from sim_backend.serial_devices import EVENT_OF_DEVICE, ClockSettings, SerialDevice, plug_in
from sim_backend.stop_signals import stop_on_signals
from sim_backend.truth import TruthFile
from sim_backend.waypoint_control import WaypointControl
from sim_backend.waypoint_service import WaypointService
from sim_backend.world import WorldError

TRUTH = "ground_truth.txt"
PORTS = "dev"
STORE = "map.db"
LAYOUT = "layout.json"


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """What to simulate and where to put it.

    Attributes:
        out: folder for ports, configuration, calibration and truth; created if absent.
        world, scenario, engine: what is driven, and by what.
        robot: rates and seeds.
        rate: simulated seconds per second.
        wait: how long to wait for a host before driving off without one, s.
        source: of odometry in the written configuration: `fused` or `odometry`.
        method: of SLAM in the written configuration; None for the daemon's default.
        listen: Zenoh endpoint in the written configuration.
        zenoh_waypoints: whether the robot also takes waypoints over Zenoh, from that endpoint.
        clocks: clocks of devices that differ from the default.
        protocols: of devices that speak another than `framed`, as `whiskers=rm3-compressed`.
        faults: a file of faults, or `seed:N`; None for a robot without.
        whisker_truth: whether a recording also says what the whiskers really did.
        compact: whether a recording is packed as tightly as it goes.
    """

    out: Path
    world: str = "thesis"
    scenario: int = 1
    engine: str = "physics"
    robot: RobotSettings = field(default_factory=RobotSettings)
    rate: float = 1.0
    wait: float = 60.0
    source: str = "fused"
    method: str | None = None
    listen: str = "tcp/127.0.0.1:7447"
    zenoh_waypoints: bool = False
    clocks: dict[str, ClockSettings] | None = None
    protocols: tuple[str, ...] = ()
    faults: str | None = None
    whisker_truth: bool = True
    compact: bool = False


@dataclass(frozen=True, slots=True)
class ReadyReport:
    """What a host needs to know when the devices are plugged in; no duration where the robot waits for waypoints."""

    ports: dict[str, Path]
    configuration: Path
    truth: Path
    duration: float | None
    length: float


@dataclass(frozen=True, slots=True)
class DriveReport:
    """What happened: packets taken and dropped by device, whether a host came, whether the drive was cut short."""

    sent: dict[str, int]
    dropped: dict[str, int]
    host_came: bool
    stopped: bool
    worst_lateness: float
    seconds: float


@dataclass(frozen=True)
class Drive:
    """What is served: a simulated robot's drive or a recorded one.

    Attributes:
        layout: of the array.
        calibration: text of the array's calibration file.
        sensor_period_us: time between two sensors of a frame.
        ticks_per_turn: of the screws' encoders.
        events: starts the drive.
        duration: s; infinite where the robot waits for waypoints.
        length: of the way driven, m.
        faults: what goes wrong.
        control: answers requests while it is driven; None where nothing can be asked for.
    """

    layout: WhiskerLayout
    calibration: str
    sensor_period_us: int
    ticks_per_turn: int
    events: Callable[[], Iterator[Event]]
    duration: float
    length: float
    faults: FaultSchedule = field(default_factory=FaultSchedule)
    control: WaypointControl | None = None


def simulated_drive(settings: SimulationSettings) -> Drive:
    """A robot in a world; its jig table and calibration are written into the folder.

    Raises:
        WorldError: no such world or scenario.
        FaultFileError: no such faults.
        OSError: a file cannot be written.
    """
    robot = _build(settings)
    layout, screws = robot.layout, settings.robot.screws
    calibration = write_calibration(settings.out.absolute(), layout, settings.robot.seed)
    faults = FaultSchedule()
    if settings.faults is not None:
        if math.isinf(robot.duration) and settings.faults.startswith("seed:"):
            raise FaultFileError(
                f"faults {settings.faults}: scenario 0 has no end to spread them over, give --max-time"
            )
        faults = faults_from_option(settings.faults, robot.duration, rows=layout.rows, cols=layout.cols)
    rest = robot.hall.field(np.zeros((layout.count, 2)), np.eye(3))
    sensors = SensorFaults(
        faults.of_sensors(), rest, cols=layout.cols, ticks_per_turn=screws.ticks_per_turn, seed=settings.robot.seed
    )
    return Drive(
        layout,
        calibration,
        robot.settings.sensor_period_us,
        screws.ticks_per_turn,
        lambda: sensors.apply(robot.events()),
        robot.duration,
        robot.motion.length,
        faults,
        None if robot.path is None else WaypointControl(robot.world, robot.path),
    )


def recorded_drive(path: Path, ticks_per_turn: int) -> Drive:
    """A recording driven again; layout and calibration are those that it carries.

    Raises:
        RecordingError, RecordedDriveError, LayoutError: it cannot be used; one line says why.
    """
    recording = Recording(path)
    attachments = recording.attachments()
    missing = [name for name in (LAYOUT, CALIBRATION) if name not in attachments]
    if missing:
        raise RecordedDriveError(f"{path}: carries no {' and no '.join(missing)}; expected them as attachments")
    truths = np.array([truth.pose[:2] for _, truth in recording.ground_truth()]).reshape(-1, 2)
    return Drive(
        layouts.from_json(attachments[LAYOUT].decode("utf-8", "replace"), f"{path}:{LAYOUT}"),
        attachments[CALIBRATION].decode("utf-8", "replace"),
        recording.sensor_period_ns // 1000,
        ticks_per_turn,
        lambda: events_of(recording, ticks_per_turn),
        recording.duration_ns * 1e-9,
        float(np.linalg.norm(np.diff(truths, axis=0), axis=1).sum()),
    )


def serve(settings: SimulationSettings, drive: Drive, on_ready: Callable[[ReadyReport], None]) -> DriveReport:
    """Serve one drive on pseudo-terminals; ends when it has been driven, or on SIGTERM or SIGINT.

    Raises:
        OSError: a file or port cannot be made.
    """
    out = settings.out.absolute()
    (out / CALIBRATION).write_text(drive.calibration, encoding="utf-8")
    (out / LAYOUT).write_text(layouts.to_json(drive.layout), encoding="utf-8")
    protocols = parse_protocols(settings.protocols)
    devices = plug_in(
        out / PORTS,
        tuple(EVENT_OF_DEVICE),
        time.monotonic_ns(),
        settings.clocks,
        protocols=protocols,
        faults=drive.faults,
        seed=settings.robot.seed,
    )
    ports = {name: device.path for name, device in devices.items()}
    (out / CONFIGURATION).write_text(_configuration(settings, drive, out, devices), encoding="utf-8")
    with TruthFile(out / TRUTH) as truth, contextlib.ExitStack() as at_end:
        control = None
        if drive.control is not None:
            control = ControlSocket(out, drive.control.answer)
            at_end.callback(control.close)
            if settings.zenoh_waypoints:
                # A scenario ends, also with waypoints after it; who waits for waypoints goes on waiting.
                service = WaypointService(out, settings.listen, ROBOT_ID, ends=not math.isinf(drive.duration))
                at_end.enter_context(service)

        def write_truth(event: TruthEvent, start: StartTime) -> None:
            truth.write(event, start.unix(event.time_ns))

        array = (drive.layout.rows, drive.layout.cols, drive.sensor_period_us)
        server = DeviceServer(devices, array, rate=settings.rate, on_truth=write_truth, control=control)
        try:
            with stop_on_signals(server.stop) as stopped:
                duration = None if math.isinf(drive.duration) else drive.duration
                on_ready(ReadyReport(ports, out / CONFIGURATION, out / TRUTH, duration, drive.length))
                # A daemon opens the ports of its configuration only: it need not ping the others.
                host_came = server.wait_for_host(settings.wait, USED_BY_SOURCE[settings.source])
                begin = time.monotonic()
                if not stopped.is_set():
                    server.serve(drive.events())
        finally:
            server.close()
    return DriveReport(
        {name: device.sent for name, device in devices.items()},
        {name: device.port.dropped for name, device in devices.items()},
        host_came,
        stopped.is_set(),
        server.worst_lateness_ns * 1e-9,
        time.monotonic() - begin,
    )


def record_drive(
    settings: SimulationSettings, path: Path, on_progress: Callable[[float], None] | None = None
) -> dict[str, int]:
    """Record one drive without devices, as fast as it goes; returns the messages written, by topic.

    Calls `on_progress` with the share of the drive that is done.

    Raises:
        WorldError: no such world or scenario, or it has no end.
        RecordingError: the recording cannot be written.
        OSError: a file cannot be made.
    """
    out = settings.out.absolute()
    drive = simulated_drive(settings)
    if math.isinf(drive.duration):
        raise WorldError("scenario 0 has no end: give --max-time to record it")
    (out / CONFIGURATION).write_text(_configuration(settings, drive, out), encoding="utf-8")
    duration_ns = 1e9 * drive.duration
    return record(
        drive.events(),
        path,
        array=(drive.layout.rows, drive.layout.cols, drive.sensor_period_us),
        attachments={
            LAYOUT: layouts.to_json(drive.layout).encode(),
            CALIBRATION: drive.calibration.encode(),
            # Without the folder, so that the same seed gives the same recording anywhere.
            CONFIGURATION: _configuration(settings, drive, Path()).encode(),
        },
        metadata={
            "world": settings.world,
            "scenario": str(settings.scenario),
            "engine": settings.engine,
            "seed": str(settings.robot.seed),
            "odometry_seed": str(settings.robot.odometry_seed),
        },
        whisker_truth=settings.whisker_truth,
        compact=settings.compact,
        on_progress=None if on_progress is None else lambda time_ns: on_progress(time_ns / duration_ns),
    )


def _build(settings: SimulationSettings) -> SimulatedRobot:
    settings.out.mkdir(parents=True, exist_ok=True)
    return build_robot(settings.world, settings.scenario, settings.engine, settings.robot)


def _configuration(
    settings: SimulationSettings, drive: Drive, folder: Path, devices: Mapping[str, SerialDevice] | None = None
) -> str:
    built_in = drive.layout.name in layouts.BUILT_IN
    if devices is None:
        ports = [framed_port(name, folder / PORTS / name) for name in EVENT_OF_DEVICE]
    else:
        ports = [Port(device.role, device.settings()) for device in devices.values()]
    return configuration_text(
        ports,
        drive.layout.name if built_in else LAYOUT,
        ticks_per_turn=drive.ticks_per_turn,
        mount_rpy_deg=settings.robot.imu.mount_rpy_deg,
        source=settings.source,
        method=settings.method,
        store=folder / STORE,
        listen=settings.listen,
    )
