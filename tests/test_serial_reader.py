"""Devices on pseudo-terminals: opened, synchronised, read, lost and found again."""

from __future__ import annotations

import contextlib
import os
import pty
import struct
import threading
import time
import tty
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

from drivers.device import DeviceStatus
from drivers.measurement import ImuSample, Measurement, ScrewAngles
from drivers.port_discovery import PortNameError, find_paths, parse_usb
from drivers.serial_reader import SerialReader
from drivers.settings import DeviceSettings
from tests.conftest import make_packet


class FakeDevice:
    """A device on a pseudo-terminal: answers PING, sends an IMU sample every 10 ms; its clock started at 1000 s."""

    CLOCK_START_US = 1_000_000_000

    def __init__(self, link: Path, payloads: list[tuple[int, bytes]] | None = None) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(self.master)
        tty.setraw(slave)
        self.slave_name = os.ttyname(slave)
        # The slave's last descriptor closed here would end the terminal before the reader opens it.
        self.slave = slave
        self.link = link
        link.unlink(missing_ok=True)
        link.symlink_to(self.slave_name)
        os.set_blocking(self.master, False)
        self.payloads = payloads or [(0x02, struct.pack("<6f", 0, 0, 0.1, 0, 0, 9.81))]
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def clock_us(self) -> int:
        return self.CLOCK_START_US + time.monotonic_ns() // 1000

    def run(self) -> None:
        sequence, pongs, received = 0, 0, b""
        while not self.stop.wait(0.01):
            with contextlib.suppress(BlockingIOError):
                received += os.read(self.master, 4096)
            *packets, received = received.split(b"\0")
            for packet in packets:
                body = cobs.decode(packet)
                if body[0] == 0xF0:
                    self.send(0x71, pongs, body[8:12])
                    pongs += 1
            for kind, payload in self.payloads:
                self.send(kind, sequence, payload)
            sequence += 1

    def send(self, kind: int, sequence: int, payload: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self.master, make_packet(kind, sequence, self.clock_us(), payload))

    def close(self) -> None:
        self.stop.set()
        self.thread.join()
        # First the name: the terminal's number may be another's at once.
        self.link.unlink(missing_ok=True)
        os.close(self.slave)
        os.close(self.master)


def first(reader: SerialReader, kind: type, seconds: float = 5.0) -> Measurement:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        item = reader.get(0.1)
        if item is not None and isinstance(item[1], kind):
            return item[1]
    raise AssertionError(f"no {kind.__name__} within {seconds} s: {reader.status()}")


def wait_for_state(reader: SerialReader, state: str, seconds: float = 5.0) -> DeviceStatus:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        reader.get(0.02)
        if reader.status()[0].state == state:
            return reader.status()[0]
    raise AssertionError(f"not {state} within {seconds} s: {reader.status()}")


def test_measurements_are_stamped_in_the_hosts_time(tmp_path):
    device = FakeDevice(tmp_path / "imu")
    try:
        with SerialReader([DeviceSettings("imu", str(tmp_path / "imu"))]) as reader:
            sample = first(reader, ImuSample)
            assert isinstance(sample, ImuSample)
            assert abs(time.monotonic_ns() - sample.stamp_ns) < 50_000_000
            assert sample.gyro == pytest.approx([0, 0, 0.1])
            assert reader.status()[0].state == "streaming"
    finally:
        device.close()


def test_encoder_ticks_unwrap_to_radians(tmp_path):
    ticks = [2**31 - 100, 0, 5, -5]
    device = FakeDevice(tmp_path / "screws", [(0x03, struct.pack("<B4i", 4, *ticks))])
    try:
        with SerialReader([DeviceSettings("screws", str(tmp_path / "screws"), ticks_per_turn=1000)]) as reader:
            start = first(reader, ScrewAngles)
            device.payloads = [(0x03, struct.pack("<B4i", 4, -(2**31) + 150, 500, 5, -255))]
            end = time.monotonic() + 5
            while time.monotonic() < end:
                last = first(reader, ScrewAngles)
                assert isinstance(start, ScrewAngles)
                assert isinstance(last, ScrewAngles)
                if last.angle[1] != start.angle[1]:
                    break
            np.testing.assert_allclose(last.angle - start.angle, 2 * np.pi * np.array([0.25, 0.5, 0.0, -0.25]))
    finally:
        device.close()


def test_a_device_that_vanishes_is_used_again_when_it_is_back(tmp_path):
    link = tmp_path / "imu"
    device = FakeDevice(link)
    with SerialReader([DeviceSettings("imu", str(link))]) as reader:
        first(reader, ImuSample)
        device.close()
        link.unlink(missing_ok=True)
        lost = wait_for_state(reader, "absent")
        assert "failed" in lost.fault or "not there" in lost.fault
        returned = time.monotonic()
        device = FakeDevice(link)
        try:
            wait_for_state(reader, "streaming")
            assert time.monotonic() - returned < 2.0
        finally:
            device.close()


def test_a_missing_port_is_reported_and_others_go_on(tmp_path):
    device = FakeDevice(tmp_path / "imu")
    try:
        settings = [DeviceSettings("imu", str(tmp_path / "imu")), DeviceSettings("gone", str(tmp_path / "none"))]
        with SerialReader(settings) as reader:
            first(reader, ImuSample)
            status = reader.status()[1]
            assert status.state == "absent"
            assert status.fault == f"port {tmp_path / 'none'} is not there"
    finally:
        device.close()


def test_a_busy_port_is_reported_as_such(tmp_path):
    device = FakeDevice(tmp_path / "imu")
    settings = [DeviceSettings("imu", str(tmp_path / "imu"))]
    try:
        with SerialReader(settings) as holder:
            first(holder, ImuSample)
            with SerialReader(settings) as second:
                end = time.monotonic() + 5
                while not second.status()[0].fault and time.monotonic() < end:
                    second.get(0.02)
                assert "another program has it open" in second.status()[0].fault
    finally:
        device.close()


def test_garbage_on_the_line_is_counted_and_survived(tmp_path):
    device = FakeDevice(tmp_path / "imu")
    try:
        with SerialReader([DeviceSettings("imu", str(tmp_path / "imu"))]) as reader:
            first(reader, ImuSample)
            os.write(device.master, bytes(range(1, 200)) + b"\0" + b"\x05\x01\0")
            end = time.monotonic() + 5
            while reader.status()[0].counters.get("bad_cobs", 0) < 1 and time.monotonic() < end:
                reader.get(0.02)
            assert reader.status()[0].counters["bad_cobs"] >= 1
            first(reader, ImuSample)
    finally:
        device.close()


def test_port_names():
    assert parse_usb("usb:2341:0043") == (0x2341, 0x43, None)
    assert parse_usb("usb:2341:0043:A:B") == (0x2341, 0x43, "A:B")
    assert find_paths("/nowhere/at/all") == []
    for bad in ("usb:xyz:1", "usb:12", "ttyUSB0", ""):
        with pytest.raises(PortNameError, match="expected"):
            SerialReader([DeviceSettings("a", bad)])
