"""The RM3 boards' line formats: values, damage, and what cannot be told apart at first sight."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.decoders import make_decoder
from drivers.measurement import HallFrame
from drivers.readings import HallReading, ScrewReading
from drivers.rm3_plaintext import Rm3PlaintextDecoder
from drivers.spherical import cartesian_frame, to_cartesian
from sim_backend.rm3_encoder import Rm3WhiskerEncoder, folded, motor_message, spherical
from tests.device_streams import LINES, fields

VALID = np.ones(64, bool)


@pytest.mark.parametrize("protocol", ["rm3-plaintext", "rm3-compressed"])
@pytest.mark.parametrize("representation", ["cartesian", "spherical-magnitude"])
def test_values_come_back_within_the_formats_step(protocol, representation):
    encoder = Rm3WhiskerEncoder(8, 8, representation)
    sent = fields(4, 1)
    encode = encoder.compressed if protocol == "rm3-compressed" else encoder.plaintext
    readings = make_decoder(protocol, 8, 8, representation).feed(b"".join(encode(VALID, field) for field in sent))
    assert len(readings) == 4
    for reading, field in zip(readings, sent, strict=True):
        assert isinstance(reading, HallReading)
        assert reading.valid.all()
        expected = folded(field) if representation == "cartesian" else spherical(folded(field))
        np.testing.assert_allclose(reading.field_mT.reshape(-1, 3), expected, atol=0.0101)
        assert reading.representation == ("Cartesian" if representation == "cartesian" else "Spherical")


@pytest.mark.parametrize("sent", ["spherical", "spherical-magnitude"])
def test_compressed_finds_out_whether_the_magnitude_is_there(sent):
    line = LINES[f"rm3-compressed {sent}"]
    readings = make_decoder("rm3-compressed", 8, 8, "spherical").feed(b"".join(line.packets(5, 3)))
    assert len(readings) == 5
    assert all(bool(reading.field_mT[..., 2].any()) == (sent != "spherical") for reading in readings)


def test_a_value_that_looks_like_a_terminator_does_not_shift_the_frames():
    # Azimuth 25.73 deg is CR LF; here one sensor never changes, so that it comes at a frame's distance each time.
    encoder = Rm3WhiskerEncoder(8, 8, "cartesian")
    sent = fields(30, 2)
    sent[:, 20, 1] = 25.735
    stream = b"".join(encoder.compressed(VALID, field) for field in sent)
    assert stream.count(b"\r\n") >= 60
    middle = 386 * 3 + 100
    decoder = make_decoder("rm3-compressed", 8, 8, "cartesian")
    readings = decoder.feed(stream[middle:])
    assert len(readings) >= 24
    for reading, field in zip(readings[::-1], sent[::-1], strict=False):
        np.testing.assert_allclose(reading.field_mT.reshape(-1, 3), folded(field), atol=0.0101)


def test_lost_bytes_cost_the_frames_that_they_hit():
    packets = LINES["rm3-compressed spherical"].packets(20, 4)
    whole = make_decoder("rm3-compressed").feed(b"".join(packets))
    packets[8] = packets[8][:100] + packets[8][117:]
    decoder = make_decoder("rm3-compressed")
    readings = decoder.feed(b"".join(packets))
    assert len(readings) == 19
    assert decoder.counters["lost_lock"] == 1
    for reading, expected in zip(readings, whole[:8] + whole[9:], strict=True):
        np.testing.assert_array_equal(reading.field_mT, expected.field_mT)


def test_sensors_that_are_zero_or_beyond_any_sensor_are_invalid():
    values = np.full((4, 3), 1000, "<i2")
    values[1] = 0
    values[2, 0] = 32000
    (first, _) = make_decoder("rm3-compressed", 2, 2, "cartesian").feed(2 * (values.tobytes() + b"\r\n"))
    assert first.valid.tolist() == [[True, False], [False, True]]
    assert not first.field_mT[1, 0].any()
    # Any value at all is a sign of life.
    alive = make_decoder("rm3-plaintext", 1, 2, "cartesian").feed(b"{[0.00;0.00;0.01][0.00;0.00;0.00]}\n")
    assert alive[0].valid.tolist() == [[True, False]]


@pytest.mark.parametrize(
    "line",
    [
        b"{[1.00;2.00;3.00]}{[1.00;2.00;3.00]}",
        b"{[1.00;2.00;3.00][1.00;2.00]}",
        b"{[1.00;2.00;3.00][1.00;2.00;3.0]}",
        b"{[1.00;2.00;3.00][1.00;2.00;3.0x]}",
        b"[1.00;2.00;3.00][1.00;2.00;3.00]}",
        b"{[1.00;2.00;3.00][1.00;2.00;3.00]}}",
        b"{[1.00;2.00;3.00][1.00;2.00;3..00]}",
        b"",
    ],
)
def test_a_line_of_another_form_is_dropped_and_counted(line):
    decoder = Rm3PlaintextDecoder(1, 2, "cartesian")
    good = b"{[1.00;2.00;3.00][-1.00;2.00;3.00]}\r\n"
    assert len(decoder.feed(line + b"\n" + good)) == 1
    assert decoder.counters == {"bad_line": 1, "packets": 1}


def test_what_is_no_number_makes_its_sensor_invalid_and_is_counted():
    decoder = Rm3PlaintextDecoder(1, 3, "cartesian")
    (reading,) = decoder.feed(b"{[nan;2.00;3.00][1.00;-inf;ovf][1.00;2.00;3.00]}\n")
    assert reading.valid.tolist() == [[False, False, True]]
    assert np.isfinite(reading.field_mT).all()
    assert decoder.counters["not_finite"] == 3


def test_an_endless_line_is_counted_once_and_the_next_is_read():
    decoder = Rm3PlaintextDecoder(1, 1, "cartesian")
    for _ in range(100):
        assert decoder.feed(b"{" * 1000) == []
    assert len(decoder._buffer) < 1000
    assert len(decoder.feed(b"\n{[1.00;2.00;3.00]}\n")) == 1
    assert decoder.counters["too_long"] == 1


@given(
    st.integers(0, 3),
    st.floats(-500, 500, width=32),
    st.none() | st.tuples(st.floats(0, 5000, width=32), st.floats(0, 30, width=32)),
)
def test_motor_messages_come_back_whatever_their_length_byte_says(motor_id, rpm, electrical):
    message = bytearray(motor_message(motor_id, rpm, electrical))
    # The length byte is wrong in the firmware; the XOR counts it all the same.
    message[5] ^= 0x5A
    message[-5] ^= 0x5A
    (reading,) = make_decoder("rm3-motor").feed(bytes(message))
    assert isinstance(reading, ScrewReading)
    assert reading.screw == motor_id
    assert reading.speed == pytest.approx(rpm * 2 * np.pi / 60)
    assert (reading.current_mA, reading.voltage_V) == (electrical or (None, None))


def test_a_trailer_among_the_floats_ends_nothing():
    for place in range(2, 11):
        floats = bytearray(struct.pack("<3f", 60.0, 400.0, 24.0))
        floats[place - 2 : place + 2] = b"CNYS"
        body = bytes([1, 12]) + bytes(floats[:12])
        check = 0
        for byte in body:
            check ^= byte
        message = b"SYNC" + body + bytes([check]) + b"CNYS"
        decoder = make_decoder("rm3-motor")
        readings = decoder.feed(motor_message(0, 1.0, (2.0, 3.0)) + message)
        assert len(readings) == 2
        expected = struct.unpack("<3f", bytes(floats[:12]))
        assert (readings[1].current_mA, readings[1].voltage_V) == pytest.approx(expected[1:])


def test_a_long_message_that_holds_a_whole_short_one_stays_long_on_a_port_that_sends_long_ones():
    head = bytes([1, 12]) + struct.pack("<f", 60.0)
    check = 0
    for byte in head:
        check ^= byte
    body = head + bytes([check]) + b"CNYS" + struct.pack("<f", 24.0)[1:]
    check = 0
    for byte in body:
        check ^= byte
    message = b"SYNC" + body + bytes([check]) + b"CNYS"
    decoder = make_decoder("rm3-motor")
    readings = decoder.feed(motor_message(0, 1.0, (2.0, 3.0)) + message)
    assert [reading.current_mA is None for reading in readings] == [False, False]
    assert decoder.counters == {"packets": 2}


def test_motor_damage_is_counted_by_reason():
    message = bytearray(motor_message(2, 30.0))
    message[8] ^= 4
    decoder = make_decoder("rm3-motor")
    assert decoder.feed(bytes(message) + b"SYNC" + bytes(30) + motor_message(7, 1.0)) == []
    assert decoder.counters["bad_check"] == 1
    assert decoder.counters["bad_frame"] == 1
    assert decoder.counters["unknown_screw"] == 1


def test_spherical_becomes_cartesian_and_without_a_magnitude_a_direction():
    field = folded(fields(1, 9)[0])
    angles = spherical(field)
    np.testing.assert_allclose(to_cartesian(angles), field, atol=1e-9)
    angles[:, 2] = 0.0
    valid = VALID.reshape(8, 8).copy()
    valid[3, 3] = False
    frame = cartesian_frame(HallFrame(5, angles.reshape(8, 8, 3), valid, 600_000, "Spherical"))
    assert frame.representation == "Direction"
    unit = (field / np.linalg.norm(field, axis=1, keepdims=True)).reshape(8, 8, 3)
    unit[3, 3] = 0.0
    np.testing.assert_allclose(frame.field_mT, unit, atol=1e-9)
