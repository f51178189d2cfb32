"""The devices on their pseudo-terminals, seen from the host: bytes in, bytes out."""

from __future__ import annotations

import contextlib
import os
import select
import struct
import termios
import threading
import time
import tty
import zlib

import numpy as np
import pytest
from cobs import cobs

from sim_backend.device_server import DeviceServer
from sim_backend.events import EncoderEvent, ImuEvent, OdometryEvent, TruthEvent, WhiskerEvent
from sim_backend.pseudo_terminal import PseudoTerminal
from sim_backend.serial_devices import ClockSettings, plug_in
from tests.conftest import make_packet

NAMES = ("whiskers", "imu", "screws", "odometry")
ARRAY = (1, 2, 600)
MS = 1_000_000


class Host:
    """What a program that opens one port does."""

    def __init__(self, path):
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.fd, termios.TCSANOW)
        self._buffer = b""

    def ping(self, nonce):
        os.write(self.fd, make_packet(0xF0, 0, 0, struct.pack("<I", nonce)))

    def packets(self, timeout=0.05):
        """(type, sequence, device time, payload) of what has come."""
        while select.select([self.fd], [], [], timeout)[0]:
            try:
                data = os.read(self.fd, 65536)
            except OSError:
                break
            if not data:
                break
            self._buffer += data
            timeout = 0.0
        *pieces, self._buffer = self._buffer.split(b"\0")
        decoded = [cobs.decode(piece) for piece in pieces]
        assert all(struct.unpack("<I", p[-4:])[0] == zlib.crc32(p[:-4]) for p in decoded)
        assert all(p[1] == 1 for p in decoded)
        return [(p[0], *struct.unpack_from("<HI", p, 2), p[8:-4]) for p in decoded]


@contextlib.contextmanager
def plugged_in(folder, names=NAMES, clocks=None):
    devices = plug_in(folder, names, time.monotonic_ns(), clocks)
    try:
        yield devices
    finally:
        for device in devices.values():
            with contextlib.suppress(OSError):
                device.port.close()


def made_events(seconds):
    """Two sensors, 25 frames a second, everything constant."""
    for k in range(round(seconds * 25)):
        t = 40 * MS * k
        pose = np.array([0.001 * k, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
        yield TruthEvent(t, t, *pose, np.zeros(3), np.zeros(3))
        up = np.array([0.0, 0.0, 9.81])
        yield ImuEvent(t, t, np.array([0.0, 0.0, 0.4]), np.array([0.1, 0.0, 9.81]), up)
        yield EncoderEvent(t, t, np.array([k, -k, 2 * k, -2 * k]), np.zeros(4))
        yield OdometryEvent(t, t, np.array([0.15, 0.0, 0.4]))
        yield WhiskerEvent(t, t + 1_200_000, np.full((2, 3), 1.5), np.array([True, False]), None)


@contextlib.contextmanager
def served(server, events):
    thread = threading.Thread(target=server.serve, args=(events,))
    thread.start()
    try:
        yield thread
    finally:
        server.stop()
        thread.join(5.0)
        assert not thread.is_alive()


def test_a_port_says_hello_and_answers_ping_with_its_clock(tmp_path):
    clocks = {"imu": ClockSettings(2**32 - 1000)}
    with plugged_in(tmp_path, ("imu",), clocks) as devices:
        plugged = time.monotonic_ns()
        host = Host(tmp_path / "imu")
        server = DeviceServer(devices, ARRAY)
        host.ping(99)
        assert server.wait_for_host(5.0, ["imu"])
        elapsed_us = (time.monotonic_ns() - plugged) / 1000
        (hello, _, hello_time, text), (pong, _, pong_time, nonce) = host.packets()
        assert (hello, text) == (0x70, b"robominer-sim imu 1.0")
        assert (pong, nonce) == (0x71, struct.pack("<I", 99))
        # It started 1 ms before its clock wrapped.
        assert hello_time >= 2**32 - 1000
        assert 0 <= (pong_time + 1000) % 2**32 <= elapsed_us + 1000


def test_a_fast_clock_runs_fast(tmp_path):
    with plugged_in(tmp_path, ("imu",), {"imu": ClockSettings(0, 100.0)}) as devices:
        start = devices["imu"].device_time_us(0)
        assert (devices["imu"].device_time_us(10**12) - start) % 2**32 == 1_000_100_000


def test_identify_brings_another_hello_and_rezero_is_counted(tmp_path):
    with plugged_in(tmp_path, ("whiskers",)) as devices:
        host = Host(tmp_path / "whiskers")
        os.write(host.fd, make_packet(0xF2, 0, 0, b"") + make_packet(0xF1, 0, 0, b""))
        devices["whiskers"].answer(time.monotonic_ns)
        assert [packet[0] for packet in host.packets()] == [0x70, 0x70]
        assert devices["whiskers"].rezeros == 1


def test_waiting_for_a_host_ends_by_itself(tmp_path):
    with plugged_in(tmp_path, ("imu",)) as devices:
        assert not DeviceServer(devices, ARRAY).wait_for_host(0.1, ["imu"])


@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_measurements_come_when_due_and_stamped_with_the_devices_clocks(tmp_path, rate):
    truth = []
    with plugged_in(tmp_path) as devices:
        hosts = {name: Host(tmp_path / name) for name in NAMES}
        server = DeviceServer(devices, ARRAY, rate=rate, on_truth=lambda e, s: truth.append((e, s)))
        begin = time.monotonic()
        with served(server, made_events(1.0)) as thread:
            thread.join(5.0)
        took = time.monotonic() - begin
        heard = {name: [p for p in host.packets() if p[0] != 0x70] for name, host in hosts.items()}
    assert 0.96 / rate < took < 0.96 / rate + 1.5
    kinds = {"whiskers": 0x01, "imu": 0x02, "screws": 0x03, "odometry": 0x05}
    for name, packets in heard.items():
        assert [packet[1] for packet in packets] == list(range(25)), name
        assert {packet[0] for packet in packets} == {kinds[name]}
        steps = np.diff([packet[2] for packet in packets]) % 2**32
        assert np.abs(steps - 40_000 / rate).max() <= 3, name
    period, bitmap = struct.unpack_from("<HB", heard["whiskers"][0][3], 2)
    assert (period, bitmap) == (600 / rate, 0b01)
    # Seen from the host, a robot that drives twice as fast.
    gyro, force = np.frombuffer(heard["imu"][0][3], "<f4").reshape(2, 3)
    np.testing.assert_allclose(gyro, [0, 0, 0.4 * rate], rtol=1e-6)
    np.testing.assert_allclose(force, [0.1 * rate**2, 0, 9.81], rtol=1e-6)
    np.testing.assert_allclose(np.frombuffer(heard["odometry"][0][3], "<f4"), [0.15 * rate, 0, 0.4 * rate], rtol=1e-6)
    assert struct.unpack("<B4i", heard["screws"][-1][3]) == (4, 24, -24, 48, -48)
    stamps = np.array([start.unix(event.time_ns) for event, start in truth])
    np.testing.assert_allclose(np.diff(stamps), 40 * MS / rate, atol=2)
    assert abs(stamps[-1] * 1e-9 - time.time()) < 3.0


def test_a_ping_is_answered_at_once_while_driving(tmp_path):
    with plugged_in(tmp_path, ("screws",)) as devices:
        host = Host(tmp_path / "screws")
        with served(DeviceServer(devices, ARRAY), made_events(30.0)):
            for nonce in range(5):
                host.ping(nonce)
                end = time.monotonic() + 1.0
                answered = False
                while not answered and time.monotonic() < end:
                    answered = any(p[0] == 0x71 and p[3] == struct.pack("<I", nonce) for p in host.packets())
                assert answered


def test_nobody_reading_does_not_stop_the_robot(tmp_path):
    with plugged_in(tmp_path, ("imu",)) as devices:
        port = devices["imu"].port
        packet = make_packet(0x02, 0, 0, bytes(24))
        for _ in range(5000):
            port.write(packet)
        assert port.dropped > 1000
        # Whoever comes later finds whole packets only.
        host = Host(tmp_path / "imu")
        first = host.packets()
        assert len(first) > 10
        port.write(packet)
        port.write(packet)
        assert len(host.packets()) >= 1


def test_an_error_of_the_simulation_ends_the_serving(tmp_path):
    def failing():
        yield from made_events(0.1)
        raise RuntimeError("broken")

    with plugged_in(tmp_path) as devices, pytest.raises(RuntimeError, match="broken"):
        DeviceServer(devices, ARRAY).serve(failing())


def test_stop_ends_the_serving_at_once(tmp_path):
    with plugged_in(tmp_path) as devices:
        server = DeviceServer(devices, ARRAY)
        threading.Timer(0.2, server.stop).start()
        begin = time.monotonic()
        server.serve(made_events(60.0))
        assert time.monotonic() - begin < 3.0


def test_unplugging_removes_the_port_and_fails_the_host(tmp_path):
    port = PseudoTerminal(tmp_path / "dev" / "one")
    host = Host(port.path)
    port.close()
    assert not port.path.is_symlink()
    with pytest.raises(OSError, match="Input/output error"):
        os.write(host.fd, b"?")
