"""Devices of every protocol over pseudo-terminals: the measurements are the simulator's, with its times."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.device import Device
from drivers.measurement import HallFrame, ImuSample, Measurement, ScrewSpeeds
from drivers.serial_reader import SerialReader
from drivers.settings import DeviceSettings
from robominer_slam.configuration.devices import device_settings
from robominer_slam.configuration.file import parse
from robominer_slam.estimation.attitude_increments import AttitudeIncrements
from sim_backend.device_server import DeviceServer, StartTime
from sim_backend.events import EncoderEvent, Event, ImuEvent, WhiskerEvent
from sim_backend.mip_encoder import MipDevice
from sim_backend.rm3_encoder import motor_message
from sim_backend.serial_devices import plug_in
from tests.device_streams import fields

MS = 1_000_000
ROLES = ("whiskers", "imu", "screws")
ARRAY = (8, 8, 600)
SPEED = np.array([1.0, -2.0, 3.0, -4.0])
TURN = 0.4


def events(seconds: float, field: np.ndarray) -> Iterator[Event]:
    """IMU at 100 Hz, screws at 50 Hz, whiskers at 25 Hz, each frame ready 38.4 ms after its first sensor."""
    made: list[Event] = []
    up = np.array([0.0, 0.0, 9.81])
    for k in range(round(seconds * 100)):
        t = 10 * MS * k
        made.append(ImuEvent(t, t, np.array([0.0, 0.0, TURN]), up + np.array([0.001 * (k % 100), 0, 0]), up))
        if k % 2 == 0:
            made.append(EncoderEvent(t, t, np.zeros(4, np.int64), SPEED * t * 1e-9))
        if k % 4 == 0:
            made.append(WhiskerEvent(t, t + 38_400_000, field[k // 4], np.ones(64, bool), None))
    yield from sorted(made, key=lambda event: event.ready_ns)


@contextlib.contextmanager
def measured(folder, protocols, seconds, field) -> Iterator[tuple[dict[str, list[Measurement]], StartTime]]:
    """What SerialReader makes of a served drive, by device, and when the drive started."""
    devices = plug_in(folder, ROLES, time.monotonic_ns(), protocols=protocols)
    server = DeviceServer(devices, ARRAY)
    text = ""
    for device in devices.values():
        keys = device.settings() | ({"sensor_period_us": 600} if device.role == "whiskers" else {})
        text += "[[device]]\n" + "".join(f"{key} = {value!r}\n" for key, value in keys.items())
    settings = device_settings(parse(text, "test.toml"))
    heard: dict[str, list[Measurement]] = {one.name: [] for one in settings}
    started: list[StartTime] = []

    def drive() -> None:
        server.wait_for_host(5.0, ROLES)
        started.append(server.serve(events(seconds, field)))

    thread = threading.Thread(target=drive)
    try:
        with SerialReader(settings) as reader:
            thread.start()
            while thread.is_alive() or (item := reader.get(0.05)) is not None:
                item = reader.get(0.05)
                if item is not None:
                    heard[item[0]].append(item[1])
            assert {status.fault for status in reader.status()} == {""}
        yield heard, started[0]
    finally:
        server.stop()
        thread.join(10.0)
        server.close()


@pytest.mark.parametrize(
    "protocols",
    [
        {"whiskers": "rm3-compressed", "imu": "bno08x-rvc", "screws": "rm3-motor"},
        {"whiskers": "rm3-plaintext", "imu": "mip:unconfigured", "screws": "rm3-motor:short"},
    ],
)
def test_stamps_and_values_are_the_simulators(tmp_path, protocols):
    seconds = 4.0
    field = fields(round(seconds * 25), 3)
    with measured(tmp_path, protocols, seconds, field) as (heard, start):
        frames = heard["whiskers"]
        assert len(frames) > 80
        lateness, last = [], -1
        sent = field.reshape(-1, 8, 8, 3)
        for frame in frames:
            assert isinstance(frame, HallFrame)
            assert frame.sensor_period_ns == 600_000
            values = sent[..., 0]
            if frame.representation != "Cartesian":
                values = np.degrees(np.arctan2(sent[..., 1], sent[..., 0]))
            # Told by what it says: on a busy machine a burst may come so late that its stamp is another frame's.
            [k] = np.flatnonzero((np.abs(frame.field_mT[..., 0] - values) < 0.0102).all(axis=(1, 2)))
            assert k > last
            last = int(k)
            lateness.append(frame.stamp_ns - start.monotonic_ns - 40 * MS * k)
        assert np.median(np.abs(lateness)) < 2 * MS
        assert np.mean(np.abs(lateness) < 10 * MS) > 0.9
        imu = heard["imu"]
        assert len(imu) > 350
        increments = AttitudeIncrements()
        rates = []
        for sample in imu:
            assert isinstance(sample, ImuSample)
            assert abs(abs(sample.acceleration[2]) - 9.81) < 0.02
            rated = increments.with_rate(sample)
            if rated.gyro is not None:
                rates.append(abs(rated.gyro[2]))
        assert np.mean(rates) == pytest.approx(TURN, abs=0.01)
        phase = np.array([(sample.stamp_ns - start.monotonic_ns) % (10 * MS) for sample in imu])
        assert np.median(np.minimum(phase, 10 * MS - phase)) < 2 * MS
        for k, name in enumerate(("front_right", "rear_right", "rear_left", "front_left")):
            speeds = heard[f"screw_{name}"]
            assert len(speeds) >= 10
            for one in speeds:
                assert isinstance(one, ScrewSpeeds)
                assert np.flatnonzero(np.isfinite(one.speed)).tolist() == [k]
                assert one.speed[k] == pytest.approx(SPEED[k], rel=1e-4)
                assert (one.voltage_V is None) == protocols["screws"].endswith("short")


def fed(device: Device, packets: list[bytes], period_ns: int, start_ns: int = 0) -> list[Measurement]:
    return [one for k, data in enumerate(packets) for one in device.received(data, start_ns + k * period_ns)]


def test_the_board_of_another_screw_is_refused_and_named():
    device = Device(DeviceSettings("screw", "/dev/x", "rm3-motor", screw="front_right"))
    device.opened("/dev/x", 0)
    assert fed(device, [motor_message(2, 10.0)] * 20, 200 * MS) == []
    assert device.counters["other_screw"] > 0
    assert device.fault == "expected the board of screw front_right, found that of rear_left"


def test_a_number_that_is_not_finite_is_never_used():
    device = Device(DeviceSettings("screw", "/dev/x", "rm3-motor"))
    device.opened("/dev/x", 0)
    packets = [motor_message(1, np.nan if k % 2 else 5.0) for k in range(40)]
    found = fed(device, packets, 200 * MS)
    assert len(found) > 10
    np.testing.assert_allclose([one.speed[1] for one in found if isinstance(one, ScrewSpeeds)], np.pi / 6)
    assert device.counters["not_finite"] == 20


def test_time_on_a_real_line_is_taken_off():
    packets = [motor_message(1, 5.0, (1.0, 2.0))] * 40
    usb, uart = (Device(DeviceSettings("screw", "/dev/x", "rm3-motor")) for _ in range(2))
    usb.opened("/dev/x", 0)
    uart.opened("/dev/x", 0, 86_806)
    earlier = fed(usb, packets, 200 * MS)[-1].stamp_ns - fed(uart, packets, 200 * MS)[-1].stamp_ns
    assert earlier == 23 * 86_806


def test_mip_is_started_at_once_again_while_silent_and_after_a_reconnect():
    chip = MipDevice("unconfigured")
    device = Device(DeviceSettings("imu", "/dev/x", "mip"))
    device.opened("/dev/x", 0)
    command = device.to_send(0)
    assert device.to_send(500 * MS) == b""
    assert device.to_send(1001 * MS) == command
    chip.feed(command)
    up = np.array([0.0, 0.0, 9.81])
    samples = [chip.sample(10_000 * k, np.zeros(3), up) for k in range(100)]
    assert len(fed(device, samples, 10 * MS, 2000 * MS)) > 80
    assert device.to_send(3100 * MS) == b""
    assert device.to_send(4100 * MS) == command
    device.lost("gone")
    assert device.to_send(9000 * MS) == b""
    device.opened("/dev/x", 9000 * MS)
    assert device.to_send(9000 * MS) == command
