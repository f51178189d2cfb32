"""The `framed` decoder: any fragmentation, any damage, never a wrong measurement."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.framed import MAX_ENCODED_BYTES, FramedDecoder, ping
from drivers.readings import (
    EncoderReading,
    HallReading,
    HelloReading,
    ImuReading,
    OdometryReading,
    PongReading,
    count_not_finite,
)
from tests.conftest import make_packet


def imu_packet(sequence: int, values: tuple[float, ...] = (0.1, 0.2, 0.3, 0.0, 0.0, 9.81)) -> bytes:
    return make_packet(0x02, sequence, 1000 * sequence, struct.pack("<6f", *values))


def hall_payload(rows: int, cols: int, valid: list[bool], raw: np.ndarray, period: int = 600) -> bytes:
    bits = bytearray((rows * cols + 7) // 8)
    for i, ok in enumerate(valid):
        bits[i // 8] |= ok << (i % 8)
    return struct.pack("<BBH", rows, cols, period) + bytes(bits) + raw.astype("<i2").tobytes()


def test_hall_frame_is_row_major_in_millitesla_with_validity_least_bit_first():
    raw = np.arange(3 * 5 * 3).reshape(3, 5, 3) - 20
    valid = [i != 7 for i in range(15)]
    (reading,) = FramedDecoder().feed(make_packet(0x01, 4, 123456, hall_payload(3, 5, valid, raw)))
    assert isinstance(reading, HallReading)
    assert reading.field_mT.shape == (3, 5, 3)
    assert reading.field_mT[1, 2] == pytest.approx(raw[1, 2] * 0.01)
    assert not reading.valid[1, 2]
    assert reading.valid.sum() == 14
    assert (reading.device_time_us, reading.sequence, reading.sensor_period_us) == (123456, 4, 600)


def test_every_type_decodes_to_si_units():
    decoder = FramedDecoder()
    stream = (
        imu_packet(1)
        + make_packet(0x03, 1, 5, struct.pack("<B4i", 4, 1, -2, 3, -4))
        + make_packet(0x04, 1, 5, struct.pack("<B12f", 4, *([60.0, 250.0, 12.0] * 4)))
        + make_packet(0x05, 1, 5, struct.pack("<3f", 0.1, -0.2, 0.3))
        + make_packet(0x70, 1, 5, b"whiskers 1.2")
        + make_packet(0x71, 1, 77, struct.pack("<I", 99))
    )
    imu, encoders, motors, odometry, hello, pong = decoder.feed(stream)
    assert isinstance(imu, ImuReading)
    assert imu.acceleration == pytest.approx([0, 0, 9.81], rel=1e-6)
    assert isinstance(encoders, EncoderReading)
    assert encoders.ticks == (1, -2, 3, -4)
    assert motors.speed == pytest.approx([2 * math.pi] * 4)
    assert isinstance(odometry, OdometryReading)
    assert odometry.velocity == pytest.approx([0.1, -0.2, 0.3], rel=1e-6)
    assert hello == HelloReading(5, 1, "whiskers 1.2")
    assert pong == PongReading(77, 1, 99)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=60))
def test_any_fragmentation_gives_the_same_readings(sizes: list[int]):
    stream = b"".join(imu_packet(i) for i in range(8))
    decoder, readings, at = FramedDecoder(), [], 0
    for size in sizes:
        readings += decoder.feed(stream[at : at + size])
        at += size
    readings += decoder.feed(stream[at:])
    assert [r.sequence for r in readings] == list(range(8))


@given(st.binary(max_size=400))
def test_garbage_before_a_packet_costs_at_most_that_packet(garbage: bytes):
    decoder = FramedDecoder()
    decoder.feed(garbage)
    readings = decoder.feed(b"\0" + imu_packet(1) + imu_packet(2))
    assert [r.sequence for r in readings if isinstance(r, ImuReading)][-2:] == [1, 2]


@given(st.data())
def test_a_damaged_packet_is_never_used(data: st.DataObject):
    packet = bytearray(imu_packet(3))
    place = data.draw(st.integers(0, len(packet) - 2))
    packet[place] ^= data.draw(st.integers(1, 255))
    decoder = FramedDecoder()
    assert decoder.feed(bytes(packet)) == []
    dropped = sum(decoder.counters[name] for name in ("bad_cobs", "bad_crc", "too_short"))
    assert dropped >= 1


def test_other_version_unknown_type_and_wrong_length_are_counted():
    decoder = FramedDecoder()
    assert decoder.feed(make_packet(0x02, 1, 0, bytes(24), version=2)) == []
    assert decoder.feed(make_packet(0x42, 1, 0, bytes(4))) == []
    assert decoder.feed(make_packet(0x02, 1, 0, bytes(23))) == []
    assert decoder.feed(make_packet(0x01, 1, 0, hall_payload(2, 2, [True] * 4, np.zeros(12))[:-1])) == []
    assert decoder.counters == {"bad_version": 1, "unknown_type": 1, "bad_payload": 2}


def test_lost_and_repeated_packets_are_counted_also_across_the_wrap():
    decoder = FramedDecoder()
    for sequence in (65534, 65535, 1, 1):
        decoder.feed(imu_packet(sequence))
    assert decoder.counters["lost"] == 1
    assert decoder.counters["duplicates"] == 1
    assert decoder.counters["packets"] == 3


def test_an_endless_packet_is_dropped_and_the_buffer_stays_bounded():
    decoder = FramedDecoder()
    for _ in range(10):
        decoder.feed(b"\x01" * (MAX_ENCODED_BYTES // 2))
    assert decoder.counters["too_long"] == 1
    assert len(decoder._buffer) <= MAX_ENCODED_BYTES
    assert len(decoder.feed(b"\0" + imu_packet(1))) == 1


def test_not_finite_numbers_are_found():
    (reading,) = FramedDecoder().feed(imu_packet(1, (math.nan, 0, 0, math.inf, 0, 9.81)))
    assert count_not_finite(reading) == 2


def test_ping_is_a_packet_of_the_protocol():
    assert ping(5, 0xDEADBEEF) == make_packet(0xF0, 5, 0, struct.pack("<I", 0xDEADBEEF))
