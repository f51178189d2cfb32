"""The daemon's own loop on a recorded drive, from the devices' bytes to Zenoh and the store, marked by stage.

Usage, on the emulated board: counted_drive.py RECORDING [SECONDS [hold]]; with `hold` it stays at the end, for a look
at its memory, until its standard input is closed.

Time is the recording's: the loop runs as fast as it goes, and what the daemon does by the clock (status, telemetry)
happens as often as it would. The back-end computes in the main thread, so that its instructions can be told apart;
what it does is the same. Zenoh's threads and the store's add to the stage that the main thread is in.
"""

from __future__ import annotations

import json
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import stages

from calibration.angle_estimator import AngleEstimator
from drivers.device import Device, DeviceStatus
from drivers.measurement import HallFrame, ImuSample, Measurement, ScrewAngles
from drivers.recording_reader import Recording
from drivers.serial_reader import TICK_NS
from drivers.settings import DeviceSettings
from robominer_slam import daemon, pipeline
from robominer_slam.calibrated_array import CalibratedArray
from robominer_slam.configuration.devices import device_settings
from robominer_slam.configuration.reload import Reload
from robominer_slam.contacts import ContactModel
from robominer_slam.estimation.robust_odometry import RobustOdometry
from robominer_slam.heap import give_large_blocks_back
from robominer_slam.map_service import MapService
from robominer_slam.notify import Notifier
from robominer_slam.pipeline import Pipeline
from robominer_slam.publisher import Publisher
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.replay import prepare
from robominer_slam.service import keep_what_is_there
from robominer_slam.slam.backend_runner import SynchronousRunner
from robominer_slam.slam.composite_scan import CompositeScan
from robominer_slam.slam.robust import RobustBackend
from robominer_slam.slam.session_backend import SessionBackend
from robominer_slam.store import MapStore
from robominer_slam.supervision import Supervision
from robominer_slam.whisker_monitor import WhiskerMonitor
from sim_backend.framed_encoder import PING, CommandDecoder, FramedEncoder

#: The devices' clocks are learned before the drive, as the daemon does while it waits for frames.
LEARNING_NS = 1_000_000_000
SENSOR_PERIOD_US = 300
#: Not the daemon's own, which may be running.
ENDPOINT = "tcp/127.0.0.1:17949"
#: A board that has measured sends within a millisecond.
ARRIVAL_NS = 1_000_000


class Board:
    """A device's side of the `framed` protocol: bytes from what it has measured, answers to pings."""

    def __init__(self, settings: DeviceSettings) -> None:
        self._settings = settings
        self._encoder, self._commands = FramedEncoder(), CommandDecoder()

    def packet(self, measurement: Measurement, time_us: int) -> bytes | None:
        """What it sends; None for what is another device's."""
        one = self._settings
        match measurement:
            case HallFrame(field_mT=field, valid=valid) if one.carries == "whiskers":
                return self._encoder.hall(
                    time_us, one.rows, one.cols, SENSOR_PERIOD_US, valid.ravel(), field.reshape(-1, 3)
                )
            case ImuSample(gyro=gyro, acceleration=acceleration) if one.carries == "imu":
                return self._encoder.imu(time_us, np.asarray(gyro), np.asarray(acceleration))
            case ScrewAngles(angle=angle) if one.carries == "screws":
                return self._encoder.encoders(time_us, np.rint(angle * one.ticks_per_turn / (2.0 * np.pi)))
        return None

    def answers(self, asked: bytes, time_us: int) -> list[bytes]:
        """PONG to each PING."""
        nonces = [int.from_bytes(payload, "little") for kind, payload in self._commands.feed(asked) if kind == PING]
        return [self._encoder.pong(time_us, nonce) for nonce in nonces]


class RecordedDevices:
    """A source of measurements: simulated devices send the recording's bytes, the daemon's decoders take them."""

    dropped = 0

    def __init__(self, recording: Recording, devices: list[Device], seconds: float, stop: threading.Event) -> None:
        self.now_ns = LEARNING_NS
        self._devices = devices
        self._stop = stop
        self._boards = {one.settings.name: Board(one.settings) for one in devices}
        self._items = self._measurements(recording, round(seconds * 1e9))

    def __enter__(self) -> RecordedDevices:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def status(self) -> list[DeviceStatus]:
        """The devices' states and counters."""
        return [one.status() for one in self._devices]

    def get(self, _: float) -> tuple[str, Measurement] | None:
        """The next (device, measurement); at the end of the drive none, and the daemon is told to stop."""
        with stages.within("not counted"):
            item = next(self._items, None)
        if item is None:
            self._stop.set()
        return item

    def _measurements(self, recording: Recording, length_ns: int) -> Iterator[tuple[str, Measurement]]:
        for device in self._devices:
            device.opened(device.settings.port, 0)
        asked_ns = 0
        for now_ns in range(0, LEARNING_NS, TICK_NS):
            yield from self._answers(now_ns)
        start_ns: int | None = None
        for _, measurement in recording:
            if start_ns is None:
                start_ns = measurement.stamp_ns - LEARNING_NS
            if measurement.stamp_ns - start_ns > LEARNING_NS + length_ns:
                return
            time_us = (measurement.stamp_ns - start_ns) // 1000
            self.now_ns = time_us * 1000 + ARRIVAL_NS
            for device in self._devices:
                data = self._boards[device.settings.name].packet(measurement, time_us)
                if data is not None:
                    yield from self._received(device, data)
            if self.now_ns - asked_ns >= TICK_NS:
                asked_ns = self.now_ns
                yield from self._answers(self.now_ns)

    @property
    def driven_s(self) -> float:
        """How much of the drive has been."""
        return (self.now_ns - LEARNING_NS) * 1e-9

    def _answers(self, now_ns: int) -> Iterator[tuple[str, Measurement]]:
        self.now_ns = now_ns
        for device in self._devices:
            with stages.within("decode"):
                asked = device.to_send(now_ns)
            for answer in self._boards[device.settings.name].answers(asked, now_ns // 1000):
                yield from self._received(device, answer)

    def _received(self, device: Device, data: bytes) -> Iterator[tuple[str, Measurement]]:
        with stages.within("decode"):
            measurements = device.received(data, self.now_ns)
        for measurement in measurements:
            yield device.settings.name, measurement


def mark_stages() -> None:
    """Tell the parts of the daemon's work apart."""
    marks: list[tuple[Any, tuple[str, ...], str]] = [
        (Pipeline, ("_matched",), "scan matching"),
        (RobustOdometry, ("add", "state_at", "mark_keyframe", "correct_pose", "relative_covariance"), "dead reckoning"),
        (RobustOdometry, ("add_contacts",), "drag"),
        (AngleEstimator, ("angles",), "angles"),
        (WhiskerMonitor, ("judge",), "health"),
        (ContactModel, ("contacts",), "contacts"),
        (pipeline, ("at_frame_start",), "contacts"),
        (CompositeScan, ("add",), "keyframe"),
        (SynchronousRunner, ("submit",), "back-end, rest"),
        (SessionBackend, ("_found", "_agreed", "look"), "closures"),
        (RobustBackend, ("_optimise",), "optimise"),
        (MapService, ("frame",), "map"),
        (Publisher, ("frame",), "publish"),
        (daemon.Daemon, ("_telemetry", "_status"), "publish"),
        (MapStore, ("add",), "store"),
    ]
    for owner, names, stage in marks:
        for name in names:
            stages.mark(owner, name, stage)


def main() -> None:
    """Drive, and print what came of it as JSON."""
    path, seconds = Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else float("inf")
    inputs = prepare(path, None)
    configuration = inputs.configuration
    mark_stages()
    stop = threading.Event()
    with tempfile.TemporaryDirectory() as folder:
        devices = [Device(one) for one in device_settings(configuration)]
        length = min(seconds, inputs.recording.duration_ns * 1e-9 + 1.0)
        source = RecordedDevices(inputs.recording, devices, length, stop)
        prefix = f"robominer/{configuration.robot.id}"
        store = MapStore(Path(folder) / "map.db", configuration.store.sync_s, configuration.robot.id, "")
        supervision = Supervision(Notifier(), Reload(path, configuration))
        section = configuration.zenoh.model_copy(update={"listen": (ENDPOINT,)})
        with ZenohBus(robot_settings(section, Path(folder), prefix), prefix) as bus, store:
            array = CalibratedArray(inputs.layout, inputs.model)
            # By the recording's time.
            running = daemon.Daemon(
                configuration,
                array,
                source,
                bus,
                store,
                supervision,
                monotonic_ns=lambda: source.now_ns,
                execution="synchronous",
            )
            keep_what_is_there()
            give_large_blocks_back()
            stages.begin("main loop")
            running.run(stop)
            stages.begin("end")
            frames, whole = running._publisher.frames, running._map
            summary = {"frames": frames, "keyframes": len(whole.keyframes), "closures": whole.closures}
            print(json.dumps(summary | {"seconds": source.driven_s}), flush=True)
            if "hold" in sys.argv:
                sys.stdin.read()


if __name__ == "__main__":
    main()
