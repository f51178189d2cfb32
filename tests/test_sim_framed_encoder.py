"""The devices' packets against packets made by hand from the interface description."""

from __future__ import annotations

import struct

import numpy as np

from sim_backend.framed_encoder import CommandDecoder, FramedEncoder
from tests.conftest import make_packet


def test_hall_packet_byte_by_byte():
    field = np.array([[1.0, -2.0, 3.004], [0.0, 0.0, 0.0], [327.67, -400.0, 400.0]])
    packet = FramedEncoder().hall(1000, 1, 3, 600, np.array([True, False, True]), field)
    payload = bytes([1, 3]) + struct.pack("<H", 600) + bytes([0b101])
    payload += struct.pack("<9h", 100, -200, 300, 0, 0, 0, 32767, -32768, 32767)
    assert packet == make_packet(0x01, 0, 1000, payload)


def test_valid_bits_run_from_the_least_significant_over_rows():
    valid = np.zeros(64, dtype=bool)
    valid[[0, 9, 63]] = True
    packet = FramedEncoder().hall(0, 8, 8, 600, valid, np.zeros((64, 3)))
    expected = bytes([8, 8]) + struct.pack("<H", 600) + bytes([1, 2, 0, 0, 0, 0, 0, 0x80]) + bytes(384)
    assert packet == make_packet(0x01, 0, 0, expected)


def test_other_packets():
    encoder = FramedEncoder()
    imu = struct.pack("<6f", 0.1, -0.2, 0.3, 0.0, 0.5, 9.81)
    assert encoder.imu(5, [0.1, -0.2, 0.3], [0.0, 0.5, 9.81]) == make_packet(0x02, 0, 5, imu)
    assert encoder.odometry(6, [0.15, 0.0, -0.4]) == make_packet(0x05, 0, 6, struct.pack("<3f", 0.15, 0.0, -0.4))
    assert encoder.hello(7, "sim 1") == make_packet(0x70, 0, 7, b"sim 1")
    assert encoder.pong(8, 0xDEADBEEF) == make_packet(0x71, 0, 8, struct.pack("<I", 0xDEADBEEF))


def test_ticks_wrap_at_32_bits():
    packet = FramedEncoder().encoders(0, [1, -1, 2**31, -(2**32) - 5])
    payload = bytes([4]) + struct.pack("<4i", 1, -1, -(2**31), -5)
    assert packet == make_packet(0x03, 0, 0, payload)


def test_each_type_counts_its_own_sequence_and_wraps():
    encoder = FramedEncoder()
    for k in range(65537):
        packet = encoder.pong(0, 1)
        if k in (0, 1, 65535, 65536):
            assert packet == make_packet(0x71, k & 0xFFFF, 0, struct.pack("<I", 1))
    assert encoder.hello(0, "x") == make_packet(0x70, 0, 0, b"x")


def test_device_time_wraps():
    assert FramedEncoder().pong(2**32 + 3, 1) == make_packet(0x71, 0, 3, struct.pack("<I", 1))


def test_commands_are_found_in_any_fragmentation_and_noise():
    ping = make_packet(0xF0, 1, 0, struct.pack("<I", 77))
    damaged = bytes([ping[0], ping[1] ^ 1]) + ping[2:]
    stream = b"\x05noise" + b"\0" + ping + damaged + make_packet(0xF2, 0, 0, b"")
    decoder = CommandDecoder()
    commands = [command for byte in stream for command in decoder.feed(bytes([byte]))]
    assert commands == [(0xF0, struct.pack("<I", 77)), (0xF2, b"")]
    assert decoder.rejected == 2


def test_endless_noise_does_not_fill_the_memory():
    decoder = CommandDecoder()
    for _ in range(100):
        assert decoder.feed(b"\x01" * 1000) == []
    assert len(decoder._buffer) <= 64
