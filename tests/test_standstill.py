"""Standing still: a ready-made odometry is held back while the rods rest, and no start is missed."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.measurement import OdometrySample
from robominer_slam import layout as layouts
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts
from robominer_slam.estimation.drag_direction import DragDirection
from robominer_slam.estimation.robust_odometry import RobustOdometry

BIAS = np.array([0.004, -0.003, 0.004])
FRAME, SAMPLE = 40_000_000, 33_333_333
#: Way per radian of what the ground does to a rod's inclination, m: 0.1 rad in some centimetres.
ROUGH, FLAT = 0.03, 1e9


def touching(inclination) -> Contacts:
    """All rods trail behind at these inclinations."""
    n = len(inclination)
    rod = 0.15 * np.array([-np.sin(inclination), np.zeros(n), -np.cos(inclination)])
    return Contacts(np.zeros((n, 3)), np.arange(n), inclination, np.full(n, np.pi), rod)


def stands(_t: float) -> float:
    return 0.0


def drive(speed, seconds: float, ground: float = ROUGH, noise: float = 1.0, silent: bool = False, seed: int = 1):
    """Pose x, y, yaw after a drive at `speed(t)` ahead, m/s, and the true way; whiskers 25 Hz, odometry 30 Hz."""
    rng = np.random.default_rng(seed)
    layout = layouts.thesis_grid()
    # Without the directions of the whiskers: what is left is the odometry, and whether the rods rest.
    settings = RobustEstimationSection(drag_least_speed=1.0)
    odometry = RobustOdometry(settings, "odometry", DragDirection(settings, layout), np.eye(4))
    phase = rng.uniform(0.0, 2.0 * np.pi, 64)
    true_way, way = 0.0, {}
    for t in range(0, round(seconds * 1000), 1):
        true_way += speed(t / 1000) / 1000
        way[t] = true_way
    samples = [(k * SAMPLE, "odometry") for k in range(1, int(seconds * 1e9 / SAMPLE))]
    frames = [(k * FRAME, "frame") for k in range(1, int(seconds * 1e9 / FRAME))]
    before = 0.0
    for stamp, kind in sorted(samples + frames):
        x = way[stamp // 1_000_000]
        if kind == "odometry":
            velocity = np.array([(x - before) / (SAMPLE * 1e-9), 0.0, 0.0]) + BIAS + noise * rng.normal(0.0, 0.05, 3)
            before = x
            odometry.add(OdometrySample(stamp, velocity))
        elif not silent:
            inclination = 0.5 + 0.1 * np.sin(x / ground + phase) + rng.normal(0.0, 0.004, 64)
            odometry.add_contacts(stamp, touching(inclination))
            odometry.state_at(stamp)
    state = odometry.state_at(round(seconds * 1e9))
    return np.array([state.x, state.y, state.yaw]), true_way, odometry


@pytest.mark.parametrize("ground", [ROUGH, FLAT])
def test_standing_robot_stays_where_it_is_and_learns_the_biases(ground):
    pose, _, odometry = drive(stands, 60.0, ground)
    np.testing.assert_allclose(pose, 0.0, atol=1e-3)  # 0.24 m and 14 deg by the biases alone
    np.testing.assert_allclose(odometry.bias, BIAS, atol=0.0025)  # 1.2 mm/s by the noise of a minute


def test_without_whiskers_it_drifts():
    """What the test above would say if nothing held the odometry back."""
    pose, _, _ = drive(stands, 60.0, silent=True)
    assert np.hypot(*pose[:2]) > 0.1


@pytest.mark.parametrize("speed", [0.05, 0.15])
@pytest.mark.parametrize("seed", range(5))
def test_no_start_is_missed(speed, seed):
    """The readings that waited count as motion: what is left is a second of noise, 3 mm, and of bias, 4 mm."""
    pose, way, _ = drive(lambda t: speed if t > 3.0 else 0.0, 4.0, noise=0.3, seed=seed)
    assert pose[0] == pytest.approx(way, abs=0.015)


def test_stop_and_go_misses_nothing():
    pose, way, _ = drive(lambda t: 0.1 if t % 2.0 < 1.0 else 0.0, 20.0, noise=0.3)
    assert pose[0] == pytest.approx(way, abs=0.06)  # 20 s of noise, 8 s of bias


def test_rods_that_rest_on_flat_ground_do_not_hold_a_robot_that_moves():
    """What was taken for standing is lost: some centimetres. Ten seconds of the bias are 4 cm more."""
    for speed in (0.05, 0.15):
        pose, way, _ = drive(lambda t, v=speed: v if t > 2.0 else 0.0, 12.0, FLAT, noise=0.3)
        assert pose[0] == pytest.approx(way, abs=0.1)


def test_wheels_that_say_exactly_nothing_teach_no_bias():
    settings = RobustEstimationSection(drag_least_speed=1.0)
    layout = layouts.thesis_grid()
    odometry = RobustOdometry(settings, "odometry", DragDirection(settings, layout), np.eye(4))
    contacts = touching(np.full(64, 0.5))
    for k in range(1, 600):
        odometry.add(OdometrySample(k * SAMPLE, np.zeros(3)))
        odometry.add_contacts(k * SAMPLE, contacts)
    state = odometry.state_at(600 * SAMPLE)
    assert (state.x, state.y, state.yaw) == (0.0, 0.0, 0.0)
    variance = np.diag(odometry._filter.P)[odometry._bias]
    np.testing.assert_allclose(variance, settings.sigma_odometry_bias**2, rtol=0.01)
