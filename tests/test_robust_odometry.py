"""The robust dead reckoning: Jacobians, gyro and screws, ready-made odometry, keyframes, attitude."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.measurement import ImuSample, OdometrySample, ScrewAngles
from robominer_slam import geometry
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.estimation.planar_motion import (
    KEY,
    REL,
    SLIP,
    SLIP_MEAN,
    Inputs,
    compose,
    compose_jacobian,
    step,
)
from robominer_slam.estimation.robust_odometry import RobustOdometry
from robominer_slam.estimation.screw_kinematics import forward_matrix
from robominer_slam.estimation.slow_walk import SlowWalk
from robominer_slam.estimation.turn_comparison import screw_turn, screw_turn_jacobian

MATRIX = forward_matrix(0.078, math.radians(30.0), 0.15, 0.30)
STEP_NS = 10_000_000
states = st.lists(st.floats(-0.5, 0.5), min_size=17, max_size=17).map(np.array)


def numeric(f, x, step=1e-6):
    return np.column_stack([(f(x + step * e) - f(x - step * e)) / (2 * step) for e in np.eye(len(x))])


@given(states, st.floats(0.001, 0.1), st.booleans(), st.booleans())
def test_motion_jacobian_equals_finite_differences(state, dt, has_gyro, has_screws):
    level = (0.98, 0.05), (-0.02, 0.99)
    inputs = Inputs(dt, 0.7 if has_gyro else None, np.array([0.2, -0.1]) if has_screws else None, level)
    moved = step(state, inputs)
    np.testing.assert_allclose(moved.by_state, numeric(lambda x: step(x, inputs).state[:6], state), atol=1e-7)
    np.testing.assert_array_equal(moved.state[6:], state[6:])
    if not has_gyro and not has_screws:
        np.testing.assert_allclose(np.reshape(moved.pose_by_velocity, (2, 3)), moved.by_state[:2, 3:6], atol=1e-12)


@given(states)
def test_compose_jacobian_equals_finite_differences(state):
    np.testing.assert_allclose(compose_jacobian(state), numeric(lambda x: np.array(compose(x)), state), atol=1e-7)
    np.testing.assert_allclose(
        geometry.T_from_xyyaw(compose(state)),
        geometry.T_from_xyyaw(state[KEY]) @ geometry.T_from_xyyaw(state[REL]),
        atol=1e-12,
    )


@given(states)
def test_screw_turn_jacobian_equals_finite_differences(state):
    state[SLIP_MEAN], state[SLIP] = np.abs(state[SLIP_MEAN]), 0.5 * state[SLIP]
    grip = 1.0 - state[SLIP_MEAN.stop - 1] - state[SLIP.stop - 1]
    if grip < 0.15:
        return
    np.testing.assert_allclose(screw_turn_jacobian(state), numeric(screw_turn, state), atol=1e-5)


def drive(
    *, seconds: float, bias=(0.0, 0.0, 0.0), turn: float = 0.0, stand: float = 5.0, slip: float = 0.16, gravity=None,
    orientation=None, source: str = "fused", **settings: float,
) -> RobustOdometry:  # fmt: skip
    """Stand, then drive with vx = 0.15 m/s and the turn rate, with noise as the sensors'."""
    rng = np.random.default_rng(1)
    inverse = np.linalg.inv(MATRIX)
    odometry = RobustOdometry(RobustEstimationSection(**settings), source, None, MATRIX)
    angle = np.zeros(4)
    up = np.array([0.0, 0.0, 9.81]) if gravity is None else np.asarray(gravity)
    for i in range(round((stand + seconds) * 100)):
        moving = i * 0.01 >= stand
        velocity = np.array([0.15, 0.0, turn]) * moving
        stamp = i * STEP_NS
        gyro = np.array([0.0, 0.0, velocity[2]]) + bias + rng.normal(0, 0.003, 3)
        force = up + np.array([0.0, velocity[0] * velocity[2], 0.0]) + rng.normal(0, 0.05, 3)
        odometry.add(ImuSample(stamp, gyro, force, orientation))
        angle = angle + inverse @ np.append(velocity / (1.0 - slip), 0.0) * 0.01
        if i % 2 == 0:
            odometry.add(ScrewAngles(stamp, angle + rng.normal(0, 0.0005, 4) * moving))
        if i % 3 == 0:
            odometry.add(OdometrySample(stamp, velocity + bias + rng.normal(0, 0.05, 3)))
    return odometry


def end(odometry: RobustOdometry, seconds: float):
    return odometry.state_at(round(seconds * 1e9))


def test_screws_that_stand_reveal_the_gyro_bias():
    odometry = drive(seconds=0.0, stand=10.0, bias=(0.001, -0.001, 0.003))
    assert odometry.bias == pytest.approx([0.003], abs=5e-4)
    state = end(odometry, 10.0)
    assert np.hypot(state.x, state.y) < 1e-3
    assert abs(state.yaw) < 0.02


def test_straight_drive_is_measured_with_the_mean_slip_taken_off():
    state = end(drive(seconds=20.0, bias=(0, 0, 0.002)), 25.0)
    assert (state.x, state.y) == (pytest.approx(3.0, abs=0.03), pytest.approx(0.0, abs=0.06))


def test_a_circle_closes_and_the_covariance_says_how_well():
    seconds = 2 * math.pi / 0.3
    state = end(drive(seconds=seconds, turn=0.3), 5.0 + seconds)
    assert np.hypot(state.x, state.y) < 0.03
    assert abs(state.yaw - 2 * math.pi) < 0.03
    assert np.all(np.linalg.eigvalsh(state.covariance) > 0)


def test_ready_made_odometry_alone_ignores_imu_and_screws():
    state = end(drive(seconds=20.0, source="odometry", turn=0.1, slip=0.5), 25.0)
    assert state.yaw == pytest.approx(2.0, abs=0.15)
    assert state.T_odom_base is None
    assert math.sqrt(state.covariance[2, 2]) > 0.02


def test_a_gap_in_the_odometry_is_no_motion():
    odometry = RobustOdometry(RobustEstimationSection(), "odometry", None, MATRIX)
    odometry.add(OdometrySample(0, np.zeros(3)))
    odometry.add(OdometrySample(3_000_000_000, np.array([1.0, 0.0, 0.0])))
    assert odometry.stale == 1
    assert abs(odometry.state_at(3_000_000_000).x) < 1e-9


def test_an_outlier_moves_little_and_a_lasting_change_is_followed():
    odometry = RobustOdometry(RobustEstimationSection(), "odometry", None, MATRIX)
    velocity = [np.array([0.1, 0.0, 0.0])] * 100 + [np.array([50.0, 0.0, 0.0])] + [np.array([1.5, 0.0, 0.0])] * 60
    seen = []
    for i, v in enumerate(velocity):
        odometry.add(OdometrySample(i * 33_333_333, v))
        seen.append(odometry.state_at(i * 33_333_333).velocity[0])
    assert odometry.outliers > 0
    assert seen[100] < 2.0
    assert seen[-1] == pytest.approx(1.5, abs=0.05)


def test_keyframe_motions_compose_to_the_pose_and_forget_what_was_before():
    odometry = RobustOdometry(RobustEstimationSection(), "odometry", None, MATRIX)
    T = np.eye(4)
    for i in range(1, 301):
        stamp = i * 33_333_333
        odometry.add(OdometrySample(stamp, np.array([0.15, 0.02, 0.3])))
        if i % 50 == 0:
            motion_since = odometry.mark_keyframe(stamp)
            T = T @ motion_since.T_last_new
            assert motion_since.bias_jacobian.shape == (6, 3)
            assert np.all(np.linalg.eigvalsh(motion_since.covariance) > 0)
    state = odometry.state_at(300 * 33_333_333)
    np.testing.assert_allclose(geometry.xyyaw_of(T), [state.x, state.y, geometry.wrap_angle(state.yaw)], atol=2e-2)
    again = odometry.mark_keyframe(300 * 33_333_333)
    np.testing.assert_allclose(again.T_last_new, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(again.covariance[np.ix_([0, 1, 5], [0, 1, 5])], 0.0, atol=1e-15)


def test_bias_jacobian_says_what_another_bias_would_have_made():
    """d eta / d bias: over a straight second, one mm/s of bias is one mm, one mrad/s turns by one mrad."""
    odometry = RobustOdometry(RobustEstimationSection(), "odometry", None, MATRIX)
    odometry.add(OdometrySample(0, np.zeros(3)))
    for i in range(1, 91):
        odometry.add(OdometrySample(i * 33_333_333, np.array([0.15, 0.0, 0.0])))
    odometry.mark_keyframe(90 * 33_333_333)
    for i in range(91, 181):
        odometry.add(OdometrySample(i * 33_333_333, np.array([0.15, 0.0, 0.0])))
    made = odometry.mark_keyframe(180 * 33_333_333)
    J = made.bias_jacobian[[0, 1, 5]]
    np.testing.assert_allclose(np.diag(J), [-3.0, -3.0, -3.0], rtol=0.1)
    assert J[1, 2] == pytest.approx(-0.15 * 3.0**2 / 2, rel=0.15)


def test_without_gravity_the_imus_own_attitude_gives_roll_and_pitch():
    tilt = geometry.matrix_to_quaternion(geometry.matrix_from_rpy([0.1, -0.05, 0.0]))
    with_attitude = end(drive(seconds=1.0, stand=15.0, gravity=(0, 0, 0), orientation=tilt), 16.0)
    assert geometry.rpy_of(with_attitude.T_odom_base)[:2] == pytest.approx([0.1, -0.05], abs=0.01)
    without = end(drive(seconds=1.0, stand=15.0, gravity=(0, 0, 0)), 16.0)
    assert np.abs(geometry.rpy_of(without.T_odom_base)[:2]).max() < 0.01


def test_a_level_body_stays_level_with_biased_sensors():
    gravity = np.array([0.03, -0.03, 9.81])
    state = end(drive(seconds=60.0, turn=0.2, gravity=gravity, bias=(0.0009, -0.0009, 0.0009)), 65.0)
    assert np.rad2deg(np.abs(geometry.rpy_of(state.T_odom_base)[:2])).max() < 0.35


def test_a_climb_raises_the_robot():
    pitch = math.radians(-10.0)
    gravity = geometry.matrix_from_rpy([0.0, pitch, 0.0]).T @ np.array([0.0, 0.0, 9.81])
    state = end(drive(seconds=20.0, gravity=gravity), 25.0)
    assert state.T_odom_base[2, 3] == pytest.approx(3.0 * math.sin(math.radians(10.0)), abs=0.06)
    assert state.x == pytest.approx(3.0 * math.cos(pitch), abs=0.06)


def test_without_an_imu_the_screws_turn_the_robot():
    odometry = RobustOdometry(RobustEstimationSection(), "fused", None, MATRIX)
    speed = np.linalg.inv(MATRIX) @ np.array([0.15, 0.0, 0.2, 0.0]) / (1.0 - 0.16)
    for i in range(501):
        odometry.add(ScrewAngles(i * 20_000_000, speed * i * 0.02))
    assert odometry.state_at(10_000_000_000).yaw == pytest.approx(2.0, abs=0.1)


def test_a_jump_of_an_encoder_moves_nothing():
    odometry = RobustOdometry(RobustEstimationSection(), "fused", None, MATRIX)
    for i in range(101):
        angle = np.zeros(4) if i < 50 else np.array([0.0, 0.0, 400.0, 400.0])
        odometry.add(ScrewAngles(i * 20_000_000, angle))
    assert abs(odometry.state_at(2_000_000_000).x) < 0.01
    assert odometry.stale == 1


def straight(seconds: float, heading: float = 0.0, bias=(0.0, 0.0, 0.0)) -> RobustOdometry:
    """Turns on the spot to a heading, marks a keyframe there and drives straight on; odometry alone."""
    odometry = RobustOdometry(RobustEstimationSection(), "odometry", None, MATRIX)
    odometry.add(OdometrySample(0, np.zeros(3)))
    for i in range(1, 31):
        odometry.add(OdometrySample(i * 33_333_333, np.array([0.0, 0.0, heading])))
    odometry.mark_keyframe(1_000_000_000)
    for i in range(31, 31 + round(30 * seconds)):
        odometry.add(OdometrySample(i * 33_333_333, np.array([0.15, 0.0, 0.0]) + bias))
    return odometry


@pytest.mark.parametrize("heading", [0.0, 1.5])
def test_a_scan_match_adds_information_only_where_it_is_told(heading):
    odometry, stamp = straight(5.0, heading), 7_000_000_000
    before, P = odometry.state_at(stamp), odometry.relative_covariance()
    ahead = np.array([math.cos(before.yaw), math.sin(before.yaw)])
    left = np.array([-ahead[1], ahead[0]])
    information = np.zeros((3, 3))
    information[:2, :2] = 1e8 * np.outer(ahead, ahead)
    odometry.correct_pose(stamp, np.append(0.01 * ahead + 0.05 * left, 0.02), information)
    after, Q = odometry.state_at(stamp), odometry.relative_covariance()
    moved = np.array([after.x - before.x, after.y - before.y])
    assert ahead @ moved == pytest.approx(0.01, abs=0.001)
    assert left @ moved == pytest.approx(0.0, abs=1e-4)
    assert after.yaw == pytest.approx(before.yaw, abs=1e-3)
    assert ahead @ Q[:2, :2] @ ahead < 0.05 * (ahead @ P[:2, :2] @ ahead)
    assert left @ Q[:2, :2] @ left == pytest.approx(left @ P[:2, :2] @ left, rel=0.01)
    assert Q[2, 2] == pytest.approx(P[2, 2], rel=0.01)


def test_a_scan_match_without_information_changes_nothing():
    odometry = straight(5.0)
    before, P = odometry.state_at(7_000_000_000), odometry.relative_covariance()
    odometry.correct_pose(7_000_000_000, np.array([0.1, 0.1, 0.1]), np.diag([0.5, 0.0, 0.1]))
    after = odometry.state_at(7_000_000_000)
    assert (after.x, after.y, after.yaw) == (before.x, before.y, before.yaw)
    np.testing.assert_array_equal(odometry.relative_covariance(), P)


def test_scan_matches_teach_the_biases_of_a_ready_made_odometry():
    bias = np.array([0.003, -0.005, 0.004])
    odometry = straight(1.0)
    stamp = 2_000_000_000
    x = odometry.state_at(stamp).x
    for i in range(61, 61 + 30 * 30):
        stamp = i * 33_333_333
        odometry.add(OdometrySample(stamp, np.array([0.15, 0.0, 0.0]) + bias))
        x += 0.15 / 30.0
        if i % 6 == 0:
            state = odometry.state_at(stamp)
            odometry.correct_pose(stamp, np.array([x - state.x, -state.y, -state.yaw]), np.diag([1e6, 1e6, 1e6]))
    np.testing.assert_allclose(odometry.bias[1:], bias[1:], atol=1e-3)
    assert odometry.bias[0] == pytest.approx(bias[0], abs=2e-3)
    assert abs(odometry.state_at(stamp).y) < 0.01


@pytest.mark.parametrize("fused", [True, False])
def test_slow_states_walk_alike_in_many_intervals_and_in_one(fused):
    settings = RobustEstimationSection()
    match = slice(17, 20) if fused else slice(12, 15)
    often, once = (SlowWalk(settings, fused, match, [1e-6, 2e-6, 3e-6]) for _ in range(2))
    due = [often.add(0.004, 0.01, 0.04) for _ in range(10)]
    once.add(0.04, 0.1, 0.4)
    assert due == [False] * 2 + [True] * 8
    (q, kept), (q_once, kept_once) = often.take(), once.take()
    np.testing.assert_allclose(q, q_once, rtol=1e-12)
    assert kept == pytest.approx(kept_once, rel=1e-12)
    assert often.take()[0] == [0.0] * match.stop, "what was told is not told again"
