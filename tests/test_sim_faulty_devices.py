"""Faults as a host meets them: through the ports of a simulated robot."""

from __future__ import annotations

import contextlib
import os
import struct
import threading
import time

import numpy as np
import pytest
from cobs import cobs

from sim_backend.device_server import DeviceServer
from sim_backend.events import EncoderEvent, ImuEvent, OdometryEvent, WhiskerEvent
from sim_backend.fault_schedule import (
    Fault,
    FaultFileError,
    FaultSchedule,
)
from sim_backend.serial_devices import plug_in
from tests.conftest import make_packet
from tests.test_sim_faults import ARRAY, MS, REST, Host


def drive(seconds):
    """What a robot that drives evenly sends: 25 frames, 100 IMU samples, 50 encoder readings a second."""
    up = np.array([0.0, 0.0, 9.81])
    for k in range(round(seconds * 100)):
        t = 10 * MS * k
        yield ImuEvent(t, t, np.array([0.0, 0.0, 0.1]), up, up)
        if k % 2 == 0:
            angle = np.array([1.0, 2.0, -3.0, -4.0]) * 0.01 * k
            yield EncoderEvent(t, t, np.floor(angle * 651.9).astype(np.int64), angle)
        if k % 4 == 0:
            yield WhiskerEvent(t, t, REST, np.ones(4, bool), None)
            yield OdometryEvent(t, t, np.array([0.1, 0.0, 0.1]))


@contextlib.contextmanager
def robot(folder, names=("whiskers", "imu", "screws"), **choices):
    devices = plug_in(folder, names, time.monotonic_ns(), **choices)
    server = DeviceServer(devices, ARRAY)
    try:
        yield devices, server
    finally:
        server.stop()
        server.close()


def test_every_protocol_is_served_beside_the_others_and_starts_when_its_host_has_come(tmp_path):
    protocols = {"whiskers": "rm3-compressed:cartesian", "imu": "bno08x-rvc", "screws": "rm3-motor"}
    with robot(tmp_path, protocols=protocols) as (devices, server):
        screws = ["screw_front_right", "screw_rear_right", "screw_rear_left", "screw_front_left"]
        assert list(devices) == ["whiskers", "imu", *screws]
        assert not server.wait_for_host(0.2, ["whiskers", "imu", "screws"])
        hosts = {name: Host(tmp_path / name) for name in devices}
        for host in hosts.values():
            host.read_some()
        assert server.wait_for_host(5.0, ["whiskers", "imu", "screws"])
        heard = dict.fromkeys(hosts, b"")
        thread = threading.Thread(target=server.serve, args=(drive(0.5),))
        thread.start()
        while thread.is_alive() or any(device.port.unread() for device in devices.values()):
            for name, host in hosts.items():
                heard[name] += host.read()
            thread.join(0.005)
    assert len(heard["whiskers"]) == 13 * 26
    assert set(heard["whiskers"][24::26] + heard["whiskers"][25::26]) == {13, 10}
    assert len(heard["imu"]) == 50 * 19
    assert heard["imu"].count(b"\xaa\xaa") == 50
    for motor_id, (name, speed) in enumerate(zip(screws, [1.0, 2.0, -3.0, -4.0], strict=True)):
        assert len(heard[name]) == 2 * 23
        assert heard[name][4] == motor_id
        assert struct.unpack_from("<f", heard[name], 6)[0] == pytest.approx(speed * 60 / (2 * np.pi), rel=1e-5)
    settings = devices["screw_rear_left"].settings()
    assert (settings["protocol"], settings["screw"]) == ("rm3-motor", "rear_left")
    assert devices["whiskers"].settings()["representation"] == "cartesian"


def test_a_mip_device_waits_for_its_command_and_must_be_told_again_after_a_replug(tmp_path):
    resume = bytes.fromhex("756501020206E5CB")
    faults = FaultSchedule((Fault("unplugged", 0.3, 0.4, "imu", {"name": "imu-2"}),))
    with robot(tmp_path, ("imu",), protocols={"imu": "mip"}, faults=faults) as (devices, server):
        host = Host(tmp_path / "imu")
        assert not server.wait_for_host(0.05, ["imu"])
        os.write(host.fd, resume)
        assert server.wait_for_host(5.0, ["imu"])
        acknowledged = host.read_some()
        assert acknowledged == bytes.fromhex("7565010404F10600") + acknowledged[-2:]
        before = []
        thread = threading.Thread(target=server.serve, args=(drive(0.8),))
        thread.start()
        while not devices["imu"].port.unplugged:
            with contextlib.suppress(OSError):
                before.append(host.read())
            thread.join(0.005)
        while not devices["imu"].port.plugged:
            thread.join(0.005)
        again = Host(tmp_path / "imu-2")
        thread.join(0.1)
        assert again.read() == b""
        os.write(again.fd, resume)
        thread.join(5.0)
        after = again.read()
    assert b"".join(before).count(b"\x75\x65\x80") >= 25
    assert after.count(b"\x75\x65\x80") >= 5
    # The clock began anew.
    reference = struct.unpack_from(">Q", after, after.index(b"\x0a\xd5") + 2)[0]
    assert reference < 0.6e9


def test_a_replugged_encoder_board_starts_counting_at_zero_and_says_hello(tmp_path):
    faults = FaultSchedule((Fault("unplugged", 0.2, 0.3, "screws"),))
    with robot(tmp_path, ("screws",), faults=faults) as (devices, server):
        host = Host(tmp_path / "screws")
        os.write(host.fd, make_packet(0xF0, 0, 0, struct.pack("<I", 1)))
        assert server.wait_for_host(5.0, ["screws"])
        thread = threading.Thread(target=server.serve, args=(drive(0.5),))
        thread.start()
        while not devices["screws"].port.unplugged:
            thread.join(0.002)
        while not devices["screws"].port.plugged:
            thread.join(0.002)
        again = Host(tmp_path / "screws")
        thread.join(5.0)
        packets = [cobs.decode(piece) for piece in again.read().split(b"\0")[:-1]]
    assert [packet[0] for packet in packets[:2]] == [0x70, 0x03]
    ticks = [struct.unpack_from("<4i", packet, 9) for packet in packets[1:]]
    # Four screws at 1, 2, -3 and -4 rad/s for 0.2 s at most.
    assert 0 < ticks[-1][0] < 140
    assert -540 < ticks[-1][3] < 0
    assert [struct.unpack_from("<H", packet, 2)[0] for packet in packets[1:]] == list(range(len(packets) - 1))


def test_a_fault_of_a_device_that_is_not_there_is_refused_before_any_port_is_made(tmp_path):
    faults = FaultSchedule((Fault("stall", 2.0, 2.6, "radar"),))
    with pytest.raises(FaultFileError, match="stall at 2 s: no device 'radar'; there are imu"):
        plug_in(tmp_path, ("imu",), 0, faults=faults)
    assert not any(tmp_path.iterdir())
