"""A robot without gyro and encoders: attitude increments and screw speeds at 5 Hz carry the odometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.bno08x_rvc import quaternion
from drivers.measurement import HallFrame, ImuSample, ScrewAngles, ScrewSpeeds
from robominer_slam.configuration.model import EstimationSection
from robominer_slam.estimation.attitude_increments import AttitudeIncrements, rotation_between
from robominer_slam.estimation.fused_odometry import FusedOdometry
from robominer_slam.estimation.screw_kinematics import forward_matrix
from robominer_slam.estimation.screw_speeds import ScrewAngleSpeeds, ScrewSpeedAssembly
from tests.test_pipeline import frame, model, pipeline_of

__all__ = ["model"]  # a fixture
MS = 1_000_000
MATRIX = forward_matrix(0.078, np.deg2rad(30.0), 0.15, 0.30)
UP = np.array([0.0, 0.0, 9.81])
rotations = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


@given(rotations, rotations)
def test_rotation_between_is_the_logarithm(first, second):
    a, b = Rotation.from_rotvec(first), Rotation.from_rotvec(second)
    found = Rotation.from_rotvec(rotation_between(a.as_quat(), -b.as_quat()))
    assert (found.inv() * a.inv() * b).magnitude() < 1e-6


def one(k: int, speed: float) -> np.ndarray:
    speeds = np.full(4, np.nan)
    speeds[k] = speed
    return speeds


def test_speeds_count_once_all_four_have_reported_anew():
    assembly = ScrewSpeedAssembly()
    found = [
        assembly.add(ScrewSpeeds(200 * MS * (i // 4) + 40 * MS * (i % 4), one(i % 4, float(i)))) for i in range(12)
    ]
    assert [i for i, speeds in enumerate(found) if speeds is not None] == [3, 7, 11]
    np.testing.assert_array_equal(found[11], [8, 9, 10, 11])
    whole = assembly.add(ScrewSpeeds(700 * MS, np.arange(4.0)))
    np.testing.assert_array_equal(whole, np.arange(4.0))


def test_a_screw_that_is_silent_stops_the_odometry_and_says_so():
    odometry = FusedOdometry(EstimationSection(), MATRIX)
    for i in range(40):
        screw = ScrewSpeeds(50 * MS * i, one(i % 4, 1.0))
        moves = odometry.measures_motion(screw)
        odometry.add(screw)
    assert moves
    for i in range(40, 80):
        screw = ScrewSpeeds(50 * MS * i, one(i % 3, 1.0))
        moves = odometry.measures_motion(screw)
        odometry.add(screw)
    assert not moves


def test_a_robot_of_such_devices_alone_knows_where_it_is():
    """A straight metre and a half, then a half circle, with the devices' steps and rates."""
    odometry, increments = FusedOdometry(EstimationSection(), MATRIX), AttitudeIncrements()
    inverse = np.linalg.inv(MATRIX)
    x = y = yaw = 0.0
    speed = np.zeros((4, 4))
    for i in range(2500):
        vx, wz = (0.15, 0.0) if 300 <= i < 1300 else (0.15, np.pi / 8) if 1300 <= i < 2100 else (0.0, 0.0)
        stamp = 10 * MS * i
        steps = round(np.degrees(yaw) * 100)
        steps = (steps + 18000) % 36000 - 18000
        odometry.add(increments.with_rate(ImuSample(stamp, None, UP, quaternion(steps, 20, -35))))
        speed[:, 0] += inverse @ np.array([vx, 0.0, wz, 0.0]) / 20.0
        for k in range(4):
            if i % 20 == 5 * k:
                odometry.add(ScrewSpeeds(stamp, one(k, speed[k, 0])))
                speed[k, 0] = 0.0
        x, y, yaw = x + vx * np.cos(yaw) * 0.01, y + vx * np.sin(yaw) * 0.01, yaw + wz * 0.01
    state = odometry.state_at(stamp)
    assert state.yaw == pytest.approx(yaw, abs=0.02)
    # Mean speeds of 0.2 s, gathered over 0.15 s more, lag by a quarter of a second: at the abrupt start and at the
    # abrupt stop, which here err the same way.
    assert np.hypot(state.x - x, state.y - y) < 2 * 0.15 * 0.25
    assert np.hypot(x, y) > 1.0


def test_the_pipeline_turns_such_an_imu_as_it_is_mounted(model):
    text = '[[device]]\nname = "imu"\nport = "/dev/x"\nprotocol = "bno08x-rvc"\nmount_rpy_deg = [180, 0, 0]\n'
    pipeline = pipeline_of(model, text)
    results = []
    for ms in range(0, 3000, 10):
        # Upside down: turning left is a falling yaw.
        sample = ImuSample(ms * MS, None, -UP, quaternion(round(-3.0 * ms), 0, 0))
        results += pipeline.add("imu", sample)
        if ms % 40 == 0:
            results += pipeline.add("whiskers", frame(ms, model))
    rate = np.deg2rad(30.0)
    assert results[-1].odometry.yaw == pytest.approx(rate * results[-1].stamp_ns * 1e-9, abs=0.03)


def test_spherical_frames_are_used_and_directions_alone_touch_nothing(model):
    cartesian = frame(0, model)
    bx, by, bz = np.moveaxis(cartesian.field_mT, -1, 0)
    angles = [np.degrees(np.arctan2(by, bx)), np.degrees(np.arctan2(bz, np.hypot(bx, by)))]
    length = np.linalg.norm(cartesian.field_mT, axis=-1)
    for magnitude, touching in ((length, 64), (np.zeros_like(length), 0)):
        spherical = HallFrame(0, np.stack([*angles, magnitude], axis=-1), cartesian.valid, 0, "Spherical")
        (result,) = pipeline_of(model, "").add("whiskers", spherical)
        assert len(result.contacts.index) == touching


def test_screw_angles_that_come_too_soon_wait_and_lose_nothing():
    speeds = ScrewAngleSpeeds(30_000_000)
    angle, told = np.zeros(4), []
    for k in range(9):
        stamp = k * 20_000_000
        speed = speeds.add(ScrewAngles(stamp, angle.copy()))
        if speed is not None:
            told.append((stamp, speed[0], speeds.readings))
        angle += 0.02 * (1.0 + k)
    # The mean over both intervals, also where the speed changes in between.
    assert [(stamp, readings) for stamp, _, readings in told] == [(40_000_000 * k, 2) for k in range(1, 5)]
    np.testing.assert_allclose([speed for _, speed, _ in told], [1.5, 3.5, 5.5, 7.5])
    assert speeds.waiting() is None
    # One that waits can be had at any time, and then the next is told from there.
    assert speeds.add(ScrewAngles(180_000_000, angle)) is None
    stamp, speed = speeds.waiting()
    assert (stamp, speeds.readings) == (180_000_000, 1)
    np.testing.assert_allclose(speed, 9.0)
    assert speeds.waiting() is None
    assert speeds.stale == 0
