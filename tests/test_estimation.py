"""Dead reckoning: kinematics, motion model, filter and integrated odometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from drivers.measurement import ImuSample, OdometrySample, ScrewAngles
from robominer_slam import geometry
from robominer_slam.configuration.model import EstimationSection
from robominer_slam.estimation.fused_odometry import FusedOdometry, motion, motion_jacobian
from robominer_slam.estimation.integrated_odometry import IntegratedOdometry, advance
from robominer_slam.estimation.screw_kinematics import forward_matrix

GEOMETRY = (0.078, np.deg2rad(30.0), 0.15, 0.30)
states = st.lists(st.floats(-3, 3), min_size=7, max_size=7).map(np.array)


@given(states, st.floats(0.001, 0.1))
def test_motion_jacobian_equals_finite_differences(state, dt):
    step = 1e-6
    numeric = np.column_stack(
        [(motion(state + step * e, dt) - motion(state - step * e, dt)) / (2 * step) for e in np.eye(7)]
    )
    np.testing.assert_allclose(motion_jacobian(state, dt), numeric, atol=1e-7)


@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3).map(np.array), st.floats(0.001, 0.5))
def test_advance_solves_the_motion_equation(velocity, interval):
    def rate(_, pose):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return [c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1], velocity[2]]

    start = np.array([0.3, -0.2, 0.9])
    solved = solve_ivp(rate, (0, interval), start, rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(advance(start, velocity, interval), solved, atol=1e-8)


def test_screw_kinematics_are_those_of_the_robot():
    r, alpha, lx, ly = GEOMETRY
    c = lx + ly / np.tan(alpha)
    w1, w2, w3, w4 = w = np.array([1.0, -2.0, 3.5, 0.7])
    expected = [
        r * np.tan(alpha) / 4 * (-w1 - w2 + w3 + w4),
        r / 4 * (-w1 + w2 + w3 - w4),
        -r / (4 * c) * (w1 + w2 + w3 + w4),
    ]
    np.testing.assert_allclose((forward_matrix(*GEOMETRY) @ w)[:3], expected)


def test_rpy_means_yaw_then_pitch_then_roll():
    np.testing.assert_allclose(
        geometry.matrix_from_rpy([0.1, -0.4, 2.0]), Rotation.from_euler("ZYX", [2.0, -0.4, 0.1]).as_matrix(), atol=1e-12
    )


def drive_fused(*, bias: float = 0.0, turn: float = 0.0, seconds: float = 20.0) -> FusedOdometry:
    """Stand for 5 s, then drive with vx = 0.15 m/s and the turn rate, with noise as the sensors'."""
    rng = np.random.default_rng(1)
    matrix = forward_matrix(*GEOMETRY)
    inverse = np.linalg.inv(matrix)
    odometry = FusedOdometry(EstimationSection(), matrix)
    angle = np.zeros(4)
    for i in range(round((5 + seconds) * 100)):
        moving = i >= 500
        velocity = np.array([0.15, 0.0, turn, 0.0]) * moving
        stamp = i * 10_000_000
        gyro = np.array([0.0, 0.0, velocity[2] + bias + rng.normal(0, 0.003)])
        odometry.add(ImuSample(stamp, gyro, np.array([0.0, 0.0, 9.81])))
        angle = angle + inverse @ velocity * 0.01
        if i % 2 == 0:
            odometry.add(ScrewAngles(stamp, angle + rng.normal(0, 0.0005, 4) * moving))
    return odometry


def test_straight_drive_is_measured_and_the_standing_robot_reveals_the_gyro_bias():
    odometry = drive_fused(bias=0.003)
    state = odometry.state_at(25_000_000_000)
    assert odometry.gyro_bias == pytest.approx(0.003, abs=5e-4)
    assert (state.x, state.y) == (pytest.approx(3.0, abs=0.03), pytest.approx(0.0, abs=0.06))
    assert abs(state.yaw) < 0.02


def test_a_circle_closes():
    seconds = 2 * np.pi / 0.3
    state = drive_fused(turn=0.3, seconds=seconds).state_at(round((5 + seconds) * 1e9))
    assert np.hypot(state.x, state.y) < 0.03
    assert abs(state.yaw - 2 * np.pi) < 0.03


def test_covariance_grows_with_the_distance_driven():
    short = drive_fused(seconds=5).state_at(10_000_000_000).covariance
    long = drive_fused(seconds=20).state_at(25_000_000_000).covariance
    assert np.all(np.linalg.eigvalsh(long) > 0)
    assert long[0, 0] > 2 * short[0, 0]


def test_integrated_odometry_holds_for_the_interval_before_the_stamp():
    odometry = IntegratedOdometry()
    odometry.add(OdometrySample(0, np.array([9.0, 9.0, 9.0])))
    odometry.add(OdometrySample(100_000_000, np.array([1.0, 0.0, 0.0])))
    odometry.add(OdometrySample(200_000_000, np.array([0.0, 2.0, 0.0])))
    state = odometry.state_at(200_000_000)
    assert (state.x, state.y) == (pytest.approx(0.1), pytest.approx(0.2))
    ahead = odometry.state_at(250_000_000)
    assert ahead.y == pytest.approx(0.3)
    assert odometry.state_at(200_000_000).y == pytest.approx(0.2)


def test_integrated_odometry_does_not_invent_motion_in_a_gap():
    odometry = IntegratedOdometry()
    odometry.add(OdometrySample(0, np.zeros(3)))
    odometry.add(OdometrySample(3_000_000_000, np.array([1.0, 0.0, 0.0])))
    assert odometry.gaps == 1
    assert odometry.state_at(3_000_000_000).x == 0.0
