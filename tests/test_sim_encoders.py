"""The simulated devices' bytes against the interface description and the data sheets' examples."""

from __future__ import annotations

import ast
import struct
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from scipy.spatial.transform import Rotation

from sim_backend import bno08x_rvc_encoder as rvc
from sim_backend import mip_encoder as mip
from sim_backend.device_protocols import PROTOCOLS, ProtocolError, parse_protocol, parse_protocols
from sim_backend.framed_encoder import FramedEncoder
from sim_backend.rm3_encoder import Rm3MotorEncoder, Rm3WhiskerEncoder, motor_message, spherical

SIMULATOR = Path(__file__).resolve().parents[1] / "sim_backend"
ALL = np.ones(4, bool)
FIELD = np.array([[1.239, -2.5, 3.0], [1.0, 2.0, -3.0], [0.0, 0.0, 12.344], [-7.0, 0.5, 0.0]])


def i16(packet):
    return np.frombuffer(packet[:-2], "<i2")


def test_no_encoder_shares_code_with_the_drivers():
    # The types in which a recording is written may be shared: bytes of a serial line never go through them.
    for path in [
        *SIMULATOR.glob("*_encoder.py"),
        *(SIMULATOR / f"{n}.py" for n in ("device_protocols", "line_faults")),
    ]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in names if name.split(".")[0] == "drivers"], path.name


def test_plaintext_is_one_line_with_two_decimals_and_a_brace_for_each_row():
    line = Rm3WhiskerEncoder(2, 2, "cartesian").plaintext(ALL, FIELD)
    assert line == b"{[1.24;-2.50;3.00][-1.00;-2.00;3.00]}{[0.00;0.00;12.34][-7.00;0.50;0.00]}\n"


def test_compressed_truncates_hundredths_toward_zero_and_ends_with_cr_lf():
    packet = Rm3WhiskerEncoder(2, 2, "cartesian").compressed(ALL, FIELD)
    assert packet[-2:] == b"\r\n"
    assert i16(packet).tolist() == [123, -250, 300, -100, -200, 300, 0, 0, 1234, -700, 50, 0]


@pytest.mark.parametrize(
    ("representation", "size"), [("cartesian", 386), ("spherical", 258), ("spherical-magnitude", 386)]
)
def test_compressed_frames_of_64_sensors_have_the_documented_lengths(representation, size):
    encoder = Rm3WhiskerEncoder(8, 8, representation)
    assert len(encoder.compressed(np.ones(64, bool), np.full((64, 3), 5.0))) == size


def test_spherical_values_are_azimuth_polar_and_magnitude_of_the_folded_field():
    np.testing.assert_allclose(spherical(np.array([[0.0, 2.0, 2.0]])), [[90.0, 45.0, np.sqrt(8.0)]])
    packet = Rm3WhiskerEncoder(1, 1, "spherical-magnitude").compressed(ALL[:1], np.array([[0.0, -3.0, -4.0]]))
    # Folded to (0, 3, 4).
    assert i16(packet).tolist() == [9000, 5313, 500]
    short = Rm3WhiskerEncoder(1, 1, "spherical").compressed(ALL[:1], np.array([[0.0, -3.0, -4.0]]))
    assert i16(short).tolist() == [9000, 5313]


def test_a_bus_error_repeats_the_last_value_and_a_sensor_that_never_answered_is_zero():
    encoder = Rm3WhiskerEncoder(1, 2, "cartesian")
    assert i16(encoder.compressed(np.array([True, False]), np.full((2, 3), 1.0))).tolist() == [100] * 3 + [0] * 3
    assert i16(encoder.compressed(np.array([False, True]), np.full((2, 3), 2.0))).tolist() == [100] * 3 + [200] * 3


@pytest.mark.parametrize(("electrical", "between"), [(None, 7), ((1200.0, 23.5), 15)])
def test_a_motor_message_has_header_checked_body_and_trailer(electrical, between):
    message = motor_message(2, -61.5, electrical)
    assert (message[:4], message[-4:]) == (b"SYNC", b"CNYS")
    body = message[4:-4]
    assert len(body) == between
    check = 0
    for byte in body[:-1]:
        check ^= byte
    assert (body[0], body[-1]) == (2, check)
    assert struct.unpack_from("<f", body, 2)[0] == -61.5
    if electrical:
        assert struct.unpack_from("<2f", body, 6) == electrical


def test_a_screws_board_reports_its_mean_speed_five_times_a_second():
    encoder = Rm3MotorEncoder(0, electrical=False)
    made = [encoder.angle(20_000_000 * k, 3.0 * 0.02 * k) for k in range(51)]
    sent = [(k, message) for k, message in enumerate(made) if message]
    assert [k for k, _ in sent] == [10, 20, 30, 40, 50]
    for _, message in sent:
        assert struct.unpack_from("<f", message, 6)[0] == pytest.approx(3.0 * 60 / (2 * np.pi), rel=1e-6)


def test_the_rvc_packet_is_the_data_sheets_byte_for_byte():
    acceleration = np.array([-371, -20, 977]) * rvc.MILLI_G
    packet = rvc.packet(222, np.array([0.01, -1.10, 20.85]), acceleration)
    assert packet == bytes.fromhex("AAAADE010092FF25088DFEECFFD103000000E7")


def attitude(packet):
    return np.array(struct.unpack_from("<3h", packet, 3)) / 100.0


def test_rvc_attitude_follows_the_motion_and_starts_at_yaw_zero():
    encoder = rvc.Bno08xRvcEncoder()
    yaw_pitch_roll = [30.0, 10.0, -5.0]
    truth = Rotation.from_euler("ZYX", yaw_pitch_roll, degrees=True)
    gravity = truth.inv().apply([0.0, 0.0, 9.81])
    first = encoder.sample(0, np.zeros(3), gravity, gravity)
    np.testing.assert_allclose(attitude(first)[1:], yaw_pitch_roll[1:], atol=0.02)
    yaw = attitude(first)[0]
    # Turned about the vertical by 0.5 rad/s for one second, tilt unchanged.
    gyro = truth.inv().apply([0.0, 0.0, 0.5])
    packets = [encoder.sample(10_000_000 * k, gyro, gravity, gravity) for k in range(1, 101)]
    np.testing.assert_allclose(attitude(packets[-1]), [yaw + np.degrees(0.5), *yaw_pitch_roll[1:]], atol=0.05)
    assert [packet[2] for packet in packets[:2]] == [1, 2]
    assert all(len(packet) == 19 and sum(packet[2:18]) & 0xFF == packet[18] for packet in packets)


def test_rvc_index_and_yaw_wrap():
    encoder = rvc.Bno08xRvcEncoder()
    up = np.array([0.0, 0.0, 9.81])
    packets = [encoder.sample(10_000_000 * k, np.array([0.0, 0.0, 2.0]), up, up) for k in range(300)]
    assert packets[256][2] == 0
    yaw = np.array([attitude(packet)[0] for packet in packets])
    assert np.abs(yaw).max() <= 180.0
    assert yaw.min() < -170.0


def test_the_mip_example_is_framed_byte_for_byte():
    data = bytes.fromhex("3E7A63A0BB8E3B297FE5BF7F")
    assert mip.packet(0x80, [mip.field(0x04, data)]) == bytes.fromhex("7565800E0E043E7A63A0BB8E3B297FE5BF7F84EE")


def parsed(packet):
    """Descriptor set and fields of one packet."""
    assert packet[:2] == b"\x75\x65"
    first = second = 0
    for byte in packet[:-2]:
        first = (first + byte) % 256
        second = (second + first) % 256
    assert packet[-2:] == bytes([first, second])
    assert packet[3] == len(packet) - 6
    fields, payload = {}, packet[4:-2]
    while payload:
        fields.setdefault(payload[1], payload[2 : payload[0]])
        payload = payload[payload[0] :]
    return packet[2], fields


def test_mip_samples_are_big_endian_in_g_with_z_down_and_carry_both_times():
    device = mip.MipDevice("streaming")
    sample = device.sample(17_250_001, np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 9.80665]))
    descriptor_set, fields = parsed(sample)
    assert descriptor_set == 0x80
    assert list(fields) == [0xD3, 0xD5, 0x04, 0x05]
    np.testing.assert_allclose(struct.unpack(">3f", fields[0x04]), [1 / 9.80665, -2 / 9.80665, -1.0], rtol=1e-6)
    np.testing.assert_allclose(struct.unpack(">3f", fields[0x05]), [0.1, -0.2, -0.3], rtol=1e-6)
    assert struct.unpack(">Q", fields[0xD5]) == (17_250_001_000,)
    time_of_week, _, valid = struct.unpack(">dHH", fields[0xD3])
    assert (time_of_week, valid) == (pytest.approx(17.250001), 0)


def command(descriptor_set, *fields):
    return mip.packet(descriptor_set, [mip.field(descriptor, data) for descriptor, data in fields])


def streams(device):
    return bool(device.sample(0, np.zeros(3), np.zeros(3)))


def test_mip_wakes_idle_and_streams_after_resume_until_set_idle():
    device = mip.MipDevice("idle")
    assert not streams(device)
    # The manual's packets for Ping, Resume and Set to Idle, and its answer to a Ping.
    (ack,) = device.feed(bytes.fromhex("756501020201E0C6"))
    assert ack == bytes.fromhex("7565010404F10100D56A")
    (ack,) = device.feed(bytes.fromhex("756501020206E5CB"))
    assert parsed(ack) == (0x01, {0xF1: b"\x06\x00"})
    assert streams(device)
    assert device.feed(bytes.fromhex("756501020202E1C7"))
    assert not streams(device)


def test_mip_as_unpacked_needs_a_format_and_a_stream_and_takes_commands_in_any_pieces():
    device = mip.MipDevice("unconfigured")
    bytes_in = command(0x0C, (0x0E, b"\x80")) + command(
        0x0C, (0x0F, bytes.fromhex("01800304000A05000AD5000A")), (0x11, b"\x01\x80\x01")
    )
    bytes_in = b"noise\x75" + bytes_in + command(0x01, (0x06, b""))
    answers = [answer for byte in bytes_in for answer in device.feed(bytes([byte]))]
    assert [answer[2] for answer in answers] == [0x0C, 0x0C, 0x01]
    assert parsed(answers[0])[1] == {0xF1: b"\x0e\x00", 0x8E: b"\x80\x03\xe8"}
    assert list(parsed(device.sample(1, np.zeros(3), np.zeros(3)))[1]) == [0x04, 0x05, 0xD5]


def test_mip_sends_every_second_sample_when_asked_for_half_the_rate():
    device = mip.MipDevice("streaming")
    device.feed(command(0x0C, (0x0F, bytes.fromhex("018001040014"))))
    assert sum(streams(device) for _ in range(100)) == 50


def test_mip_refuses_what_it_does_not_know_and_ignores_damage():
    device = mip.MipDevice("idle")
    (answer,) = device.feed(command(0x0C, (0x55, b"")))
    assert parsed(answer)[1] == {0xF1: b"\x55\x01"}
    (answer,) = device.feed(command(0x0C, (0x0F, b"\x01\x80\x01\x77\x00\x0a")))
    assert parsed(answer)[1] == {0xF1: b"\x0f\x03"}
    damaged = bytearray(command(0x01, (0x06, b"")))
    damaged[5] ^= 1
    assert device.feed(bytes(damaged)) == []
    assert device.feed(command(0x01, (0x01, b"")))


def test_framed_motors_carry_speed_current_and_voltage_of_each_screw():
    packet = cobs.decode(FramedEncoder().motors(5, np.arange(12.0).reshape(4, 3))[:-1])
    assert packet[0] == 0x04
    assert packet[8] == 4
    np.testing.assert_array_equal(np.frombuffer(packet[9:-4], "<f4"), np.arange(12.0))


def test_protocols_are_chosen_by_device_with_the_firmwares_usual_variant():
    assert parse_protocol("whiskers", "rm3-compressed") == ("rm3-compressed", "spherical")
    assert parse_protocols(["whiskers=rm3-compressed:cartesian", "imu=mip"]) == {
        "whiskers": "rm3-compressed:cartesian",
        "imu": "mip",
    }
    for device, offered in PROTOCOLS.items():
        for name, variants in offered.items():
            assert parse_protocol(device, name)[1] in (*variants, "")


@pytest.mark.parametrize("option", ["whiskers", "imu=rm3-motor", "radar=framed", "imu=mip:asleep", "odometry=framed:x"])
def test_a_protocol_that_a_device_does_not_speak_is_refused_in_one_line(option):
    with pytest.raises(ProtocolError) as error:
        parse_protocols([option])
    assert "\n" not in str(error.value)
