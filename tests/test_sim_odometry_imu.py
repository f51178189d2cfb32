"""IMU and ready-made odometry: what they say of a known motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation

from sim_backend.base_motion import LevelGrid
from sim_backend.hall_drift import DriftSettings, HallDrift
from sim_backend.imu import GRADES, Imu, ImuSettings
from sim_backend.odometry import BiasedOdometry, OdometrySettings, mean_body_velocity
from sim_backend.waypoints import WaypointPath

CURVE = LevelGrid(WaypointPath([[0, 0, 0.3], [1.0, 0.5, 2.0], [0.2, 0.9, -1.0]]))
STILL = LevelGrid(WaypointPath([[0, 0, 0.7]]))
QUIET = ImuSettings(
    gyro_step=0.0,
    acceleration_step=0.0,
    gyro_noise=0.0,
    gyro_bias=0.0,
    gyro_bias_drift=0.0,
    acceleration_noise=0.0,
    acceleration_bias=0.0,
)


def integrate(velocity, dt, start):
    """Odometry as it is integrated: constant body velocity over each interval, in its own heading."""
    x, y, heading = start
    for vx, vy, wz in velocity:
        turn = wz * dt
        mean = heading + turn / 2
        chord = np.sinc(turn / 2 / np.pi) * dt
        x += chord * (np.cos(mean) * vx - np.sin(mean) * vy)
        y += chord * (np.sin(mean) * vx + np.cos(mean) * vy)
        heading += turn
    return np.array([x, y, heading])


def test_mean_body_velocity_integrates_to_the_true_path():
    time = np.arange(0.0, CURVE.duration, 1 / 30)
    velocity = mean_body_velocity(CURVE.at(time), 1 / 30)
    expected = CURVE.path.at(time[-1:]).pose[0]
    np.testing.assert_allclose(integrate(velocity, 1 / 30, CURVE.path.at([0.0]).pose[0]), expected, atol=1e-9)


def test_odometry_noise_has_the_drawn_bias_and_the_deviation():
    odometry = BiasedOdometry(4)
    velocity = odometry.sample(STILL.at(np.arange(60001) / 30))
    np.testing.assert_allclose(velocity.mean(axis=0), odometry.bias, atol=1e-3)
    np.testing.assert_allclose(velocity.std(axis=0), 0.05, rtol=0.02)


def test_deviation_is_per_sample_at_thirty_hertz():
    slow = BiasedOdometry(4, OdometrySettings(rate=7.5))
    velocity = slow.sample(STILL.at(np.arange(20001) / 7.5))
    np.testing.assert_allclose(velocity.std(axis=0), 0.025, rtol=0.03)


def test_biases_are_of_one_to_five_millimetres_of_either_sign():
    biases = np.array([BiasedOdometry(seed).bias for seed in range(40)])
    assert (np.abs(biases) >= 0.001).all()
    assert (np.abs(biases) <= 0.005).all()
    assert ((biases > 0).any(axis=0) & (biases < 0).any(axis=0)).all()


def test_imu_at_rest_feels_gravity_upwards():
    gyro, force = Imu(1, QUIET).sample(STILL.at(np.arange(5) / 100))
    np.testing.assert_allclose(gyro, 0.0, atol=1e-12)
    np.testing.assert_allclose(force, [[0, 0, 9.81]] * 5, atol=1e-12)


def test_quiet_imu_integrates_to_the_true_heading_and_velocity():
    time = np.arange(0.0, 6.0, 0.01)
    motion = CURVE.at(time)
    gyro, force = Imu(1, QUIET).sample(motion)
    heading = CURVE.path.at(time).pose[:, 2]
    assert trapezoid(gyro[:, 2], time) == pytest.approx(heading[-1] - heading[0], abs=1e-4)
    in_map = np.einsum("nij,nj->ni", motion.R, force) - [0, 0, 9.81]
    np.testing.assert_allclose(trapezoid(in_map, time, axis=0), motion.velocity[-1], atol=1e-3)


def test_imu_noise_and_bias_have_their_sizes():
    gyro, force = Imu(2).sample(STILL.at(np.arange(20000) / 100))
    np.testing.assert_allclose(gyro.std(axis=0), 0.003, rtol=0.05)
    np.testing.assert_allclose(force.std(axis=0), 0.05, rtol=0.05)
    biases = [Imu(seed).sample(STILL.at(np.arange(400) / 100)) for seed in range(60)]
    gyro_bias = np.array([g.mean(axis=0) for g, _ in biases])
    assert gyro_bias.std() == pytest.approx(np.deg2rad(0.05), rel=0.3)
    force_bias = np.array([f.mean(axis=0) - [0, 0, 9.81] for _, f in biases])
    assert force_bias.std() == pytest.approx(0.03, rel=0.3)


def test_touch_down_ends_smoothly_at_the_start():
    time = np.arange(-3.5, 0.5, 0.001)
    states = CURVE.at(time)
    np.testing.assert_allclose(np.gradient(states.position, 0.001, axis=0)[5:-5], states.velocity[5:-5], atol=1e-3)
    assert states.position[0, 2] > 0.1
    np.testing.assert_allclose(states.position[-1], 0.0, atol=1e-12)


def test_a_mounted_imu_measures_in_its_own_axes():
    time = np.arange(0.0, 6.0, 0.01)
    motion = CURVE.at(time)
    level_gyro, level_force = Imu(1, QUIET).sample(motion)
    gyro, force = Imu(1, replace(QUIET, mount_rpy_deg=(180.0, 0.0, 90.0))).sample(motion)
    R = Rotation.from_euler("ZYX", [90, 0, 180], degrees=True).as_matrix()
    np.testing.assert_allclose(gyro @ R.T, level_gyro, atol=1e-12)
    np.testing.assert_allclose(force @ R.T, level_force, atol=1e-12)
    np.testing.assert_allclose(force[0], [0, 0, -9.81], atol=1e-12)


def test_the_robots_own_flavour_has_no_gravity():
    _, acceleration = Imu(1, replace(QUIET, gravity_free=True)).sample(STILL.at(np.arange(5) / 100))
    np.testing.assert_allclose(acceleration, 0.0, atol=1e-12)


def test_a_bno080_reports_in_steps_and_a_cv7_is_quieter():
    motion = STILL.at(np.arange(5000) / 100)
    gyro, force = Imu(3).sample(motion)
    np.testing.assert_allclose(gyro * 512, np.round(gyro * 512), atol=1e-9)
    np.testing.assert_allclose(force * 256, np.round(force * 256), atol=1e-9)
    better, _ = Imu(3, GRADES["3dm-cv7"]).sample(motion)
    assert better.std() < gyro.std() / 2


def test_drift_starts_at_zero_and_grows_slowly():
    rest = np.tile([0.5, -0.5, 40.0], (64, 1))
    drift = HallDrift(1, 64)
    np.testing.assert_allclose(drift.apply(rest, 0.0), rest)
    for _ in range(3600):
        later = drift.apply(rest, 1.0)
    walked = (later - later.mean(axis=0)).std(axis=0)
    np.testing.assert_allclose(walked, 0.005 * 60, rtol=0.3)
    warm = HallDrift(1, 1, DriftSettings(offset_walk=0.0))
    strength = np.array([warm.apply(rest[:1], 60.0)[0, 2] for _ in range(2000)]) / 40.0
    assert np.std(strength) == pytest.approx(0.0033, rel=0.25)
