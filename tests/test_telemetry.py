"""The telemetry message: small enough, and decoded to what was meant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robominer_slam.publishing.telemetry import (
    MAX_BYTES,
    MAX_WHISKERS,
    STATES,
    Health,
    Telemetry,
    TelemetryError,
    decode,
    encode,
)


def telemetry(rows: int = 8, cols: int = 8, seed: int = 0) -> Telemetry:
    rng = np.random.default_rng(seed)
    inclination = rng.uniform(0.0, np.pi / 2, (rows, cols))
    inclination[rng.random((rows, cols)) < 0.3] = 0.0
    inclination[rng.random((rows, cols)) < 0.1] = np.nan
    q = rng.normal(size=4)
    return Telemetry(
        sequence=int(rng.integers(65536)),
        stamp_ns=1_700_000_000_123_456_789,
        state=STATES[seed % 4],
        pose=np.concatenate([rng.normal(0, 20, 3), q / np.linalg.norm(q)]),
        sigmas=rng.uniform(0, 2, 6),
        velocity=rng.normal(0, 0.3, 3),
        contacts=int(np.count_nonzero(inclination > 0)),
        inclination=inclination,
        azimuth=rng.uniform(-np.pi, np.pi, (rows, cols)),
        health=Health.IMU_SILENT | Health.PAUSED,
        map_version=1234,
        keyframes=567,
        closures=89,
    )


@settings(max_examples=50)
@given(st.integers(0, 2**31), st.sampled_from([(8, 8), (10, 8), (1, 1), (5, 3)]))
def test_the_decoded_state_is_within_the_steps_of_the_original(seed: int, shape: tuple[int, int]) -> None:
    sent = telemetry(*shape, seed=seed)
    data = encode(sent)
    assert len(data) <= MAX_BYTES
    got = decode(data)
    for name in ("sequence", "stamp_ns", "state", "contacts", "health", "map_version", "keyframes", "closures"):
        assert getattr(got, name) == getattr(sent, name), name
    np.testing.assert_array_equal(got.pose, sent.pose.astype(np.float32))
    np.testing.assert_allclose(got.sigmas[:3], sent.sigmas[:3], atol=0.5001e-3)
    np.testing.assert_allclose(got.sigmas[3:], sent.sigmas[3:], atol=0.5001e-4)
    np.testing.assert_allclose(got.velocity, sent.velocity, atol=0.5001e-3)
    invalid = np.isnan(sent.inclination)
    np.testing.assert_array_equal(np.isnan(got.inclination), invalid)
    np.testing.assert_array_equal(got.inclination == 0.0, sent.inclination == 0.0)
    error = np.abs(got.inclination - sent.inclination)[~invalid]
    assert error.max(initial=0.0) <= np.radians(3.22)
    touching = ~invalid & (sent.inclination > 0.0)
    turn = (got.azimuth - sent.azimuth + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turn[touching]).max(initial=0.0) <= np.radians(11.26)
    assert (got.azimuth[touching] > -np.pi).all()
    assert (got.azimuth[touching] <= np.pi).all()


def test_the_whole_array_of_the_robot_fits() -> None:
    assert MAX_WHISKERS >= 80
    assert len(encode(telemetry(10, 8))) == 154
    assert len(encode(telemetry(8, 8))) == 138


def test_an_array_that_does_not_fit_is_left_out_and_the_rest_stays() -> None:
    sent = telemetry(16, 16)
    got = decode(encode(sent))
    assert got.inclination.shape == (0, 0)
    assert got.contacts == sent.contacts


def test_the_bytes_lie_as_documented() -> None:
    sent = replace(
        telemetry(1, 4),
        sequence=0x10002,
        sigmas=np.array([0.001, np.inf, 100.0, 0.0001, np.nan, 0.0]),
        velocity=np.array([-0.001, 1e9, 0.002]),
        inclination=np.radians([[0.0, 1.0, 90.0, 90.0]]),
        azimuth=np.array([[1.0, -np.pi, np.pi, np.nan]]),
    )
    data = encode(sent)
    assert data[0] == 1
    assert data[4:6] == b"\x02\x00"
    assert np.frombuffer(data, "<i8", 1, 6)[0] == sent.stamp_ns
    assert np.frombuffer(data, "<u2", 6, 42).tolist() == [1, 65535, 65535, 1, 65535, 0]
    assert np.frombuffer(data, "<i2", 3, 54).tolist() == [-1, 32767, 2]
    assert np.frombuffer(data, "<u4", 2, 60).tolist() == [1234, 567]
    assert np.frombuffer(data, "<u2", 2, 68).tolist() == [89, sent.contacts]
    assert data[72:74] == b"\x01\x04"
    assert data[74:] == bytes([0x00, 0x10, 0xE0, 0xF0])


@given(st.binary(max_size=220))
def test_garbage_is_refused_or_decoded_but_never_raises_anything_else(data: bytes) -> None:
    for junk in (data, b"\x01" + data):
        try:
            decode(junk)
        except TelemetryError:
            continue
        assert junk[0] == 1


def test_messages_of_another_version_or_length_are_refused() -> None:
    data = encode(telemetry())
    with pytest.raises(TelemetryError, match="version 2, expected 1"):
        decode(b"\x02" + data[1:])
    with pytest.raises(TelemetryError, match="contradicts itself"):
        decode(data + b"\0")
    with pytest.raises(TelemetryError, match="expected 74 or more"):
        decode(data[:50])


def test_states_that_make_no_sense_are_refused() -> None:
    with pytest.raises(TelemetryError, match="'asleep'"):
        encode(replace(telemetry(), state="asleep"))
    with pytest.raises(TelemetryError, match="not finite"):
        encode(replace(telemetry(), pose=np.full(7, np.nan)))
