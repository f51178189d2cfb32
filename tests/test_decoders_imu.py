"""The two IMUs: data sheets' examples byte for byte, losses, damage, and the commands that start a MicroStrain."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.decoders import make_decoder
from drivers.mip import FORMATS, MESSAGE_FORMAT, MipDecoder, start_streaming
from drivers.readings import ImuReading, count_not_finite
from sim_backend import bno08x_rvc_encoder as rvc
from sim_backend import mip_encoder as mip

RVC_EXAMPLE = bytes.fromhex("AAAADE010092FF25088DFEECFFD103000000E7")
MIP_EXAMPLE = bytes.fromhex("7565800E0E043E7A63A0BB8E3B297FE5BF7F84EE")
UP = np.array([0.0, 0.0, 9.81])


def test_the_rvc_data_sheets_example():
    (reading,) = make_decoder("bno08x-rvc").feed(RVC_EXAMPLE)
    assert isinstance(reading, ImuReading)
    assert (reading.sequence, reading.gyro, reading.device_time_us) == (222, None, None)
    np.testing.assert_allclose(reading.acceleration, np.array([-371, -20, 977]) * 9.80665e-3)
    angles = Rotation.from_quat(reading.orientation_xyzw).as_euler("ZYX", degrees=True)
    np.testing.assert_allclose(angles, [0.01, -1.10, 20.85], atol=1e-9)


@given(st.tuples(st.floats(-179.9, 179.9), st.floats(-89, 89), st.floats(-179.9, 179.9)))
def test_rvc_attitude_is_yaw_then_pitch_then_roll(angles):
    (reading,) = make_decoder("bno08x-rvc").feed(rvc.packet(0, np.array(angles), UP))
    truth = Rotation.from_euler("ZYX", angles, degrees=True)
    assert (truth.inv() * Rotation.from_quat(reading.orientation_xyzw)).magnitude() < np.radians(0.015)


def test_rvc_losses_are_counted_across_the_wrap_and_a_restart_is_none():
    decoder = make_decoder("bno08x-rvc")
    for index in (253, 254, 2, 3, 0, 1):
        decoder.feed(rvc.packet(index, np.zeros(3), UP))
    assert decoder.counters["lost"] == 3
    assert decoder.counters["packets"] == 6


def test_rvc_damage_is_dropped_and_headers_may_stand_anywhere():
    decoder = make_decoder("bno08x-rvc")
    damaged = bytearray(RVC_EXAMPLE)
    damaged[7] ^= 16
    follows = rvc.packet(0xAA, np.zeros(3), UP)
    readings = decoder.feed(bytes(damaged) + b"\xaa\xaa" + RVC_EXAMPLE + b"\xaa" + follows)
    assert [reading.sequence for reading in readings] == [222, 0xAA]
    assert decoder.counters["bad_check"] >= 1


def test_the_mip_manuals_example_is_a_valid_packet_whose_z_is_not_finite():
    decoder = make_decoder("mip")
    (reading,) = decoder.feed(MIP_EXAMPLE)
    x, y, z = reading.acceleration
    assert (x, y) == pytest.approx(np.array(struct.unpack(">2f", MIP_EXAMPLE[6:14])) * 9.80665)
    assert np.isnan(z)
    assert reading.gyro is None
    assert count_not_finite(reading) == 1
    assert decoder.counters == {"packets": 1}


def test_mip_samples_carry_the_time_since_power_up_and_the_devices_own_axes():
    device = mip.MipDevice("streaming")
    (reading,) = make_decoder("mip").feed(device.sample(17_250_001, np.array([0.1, 0.2, 0.3]), UP))
    assert reading.device_time_us == 17_250_001
    np.testing.assert_allclose(reading.gyro, [0.1, -0.2, -0.3], rtol=1e-6)
    np.testing.assert_allclose(reading.acceleration, [0, 0, -9.81], rtol=1e-6)


def test_mip_takes_the_gps_time_where_there_is_no_other_and_skips_unknown_fields():
    fields = [mip.field(0x77, b"abc"), mip.field(0xD3, struct.pack(">dHH", 1.5, 0, 0)), mip.field(0x05, bytes(12))]
    (reading,) = make_decoder("mip").feed(mip.packet(0x80, fields))
    assert (reading.device_time_us, reading.acceleration) == (1_500_000, None)


@given(st.integers(2, 19), st.integers(1, 255))
def test_a_damaged_mip_packet_is_never_used_and_the_next_one_is(place, change):
    damaged = bytearray(MIP_EXAMPLE)
    damaged[place] ^= change
    decoder = make_decoder("mip")
    good = [mip.packet(0x80, [mip.field(0x05, bytes([k] * 12))]) for k in range(20)]
    readings = decoder.feed(bytes(damaged) + b"".join(good))
    assert all(reading.acceleration is None for reading in readings)
    assert len(readings) == 20
    assert decoder.counters["bad_check"] >= 1


def test_mip_fields_that_do_not_fit_and_other_packets_are_counted():
    decoder = make_decoder("mip")
    wrong = [mip.packet(0x80, [b"\x0e\x04\x00"]), mip.packet(0x80, [b"\x00\x04"]), mip.packet(0x80, [b"\x03\x05\x00"])]
    assert decoder.feed(b"".join(wrong) + mip.packet(0x82, [mip.field(0x10, bytes(4))])) == []
    assert decoder.counters == {"bad_payload": 3, "other_packets": 1}


@pytest.mark.parametrize("power_up", ["idle", "unconfigured", "streaming"])
def test_the_start_commands_make_any_device_stream(power_up):
    device, decoder = mip.MipDevice(power_up), MipDecoder()
    for answer in device.feed(start_streaming(FORMATS[0])):
        assert decoder.feed(answer) == []
    assert not decoder.refused
    (reading,) = decoder.feed(device.sample(5_000, np.zeros(3), UP))
    assert reading.device_time_us == 5_000


def test_a_refused_command_is_seen():
    decoder = MipDecoder()
    decoder.feed(mip.packet(0x0C, [mip.field(0xF1, bytes([MESSAGE_FORMAT, 0x03]))]))
    assert decoder.refused == {MESSAGE_FORMAT}
    assert decoder.counters["refused"] == 1
