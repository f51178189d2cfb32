"""The screws' inverse kinematics against the robot's forward formulas, and their slip."""

from __future__ import annotations

import numpy as np
import pytest

from sim_backend.screws import ScrewEncoders, ScrewSettings, screw_speeds

R, ALPHA, LX, LY = 0.078, np.deg2rad(30.0), 0.15, 0.30
C = LX + LY / np.tan(ALPHA)


def forward(w):
    """The brief's formulas, written out."""
    w1, w2, w3, w4 = w
    return np.array(
        [
            R * np.tan(ALPHA) / 4 * (-w1 - w2 + w3 + w4),
            R / 4 * (-w1 + w2 + w3 - w4),
            -R / (4 * C) * (w1 + w2 + w3 + w4),
        ]
    )


@pytest.mark.parametrize("velocity", [[0.15, 0, 0], [0, 0.1, 0], [0, 0, 0.4], [0.1, -0.07, 0.3]])
def test_screw_speeds_give_the_wanted_velocity(velocity):
    np.testing.assert_allclose(forward(screw_speeds(np.array(velocity))), velocity, atol=1e-12)


def test_screw_speeds_are_the_least_that_give_the_velocity():
    velocity = np.array([0.1, -0.07, 0.3])
    matrix = np.column_stack([forward(unit) for unit in np.eye(4)])
    np.testing.assert_allclose(screw_speeds(velocity), np.linalg.pinv(matrix) @ velocity, atol=1e-12)


def test_fourth_mode_moves_nothing():
    speeds = screw_speeds(np.zeros(3), 2.0)
    np.testing.assert_allclose(forward(speeds), 0.0, atol=1e-12)
    assert speeds @ [1, -1, 1, -1] / 4 == pytest.approx(2.0)


def drive(settings, velocity, n=500, seed=3):
    encoders = ScrewEncoders(seed, settings)
    position = np.cumsum(np.tile(velocity[:2], (n, 1)), axis=0) / settings.rate
    return encoders, encoders.advance(position, np.tile(velocity, (n, 1)))


def test_without_slip_and_noise_the_angles_integrate_the_velocity():
    settings = ScrewSettings(slip=(0.0, 0.0), internal_slip=0.0, noise=0.0)
    _, angles = drive(settings, [0.15, 0.0, 0.1])
    np.testing.assert_allclose(forward(angles[-1]), 10.0 * np.array([0.15, 0.0, 0.1]), atol=1e-9)


def test_slip_stays_in_its_range_and_changes_over_a_metre():
    encoders = ScrewEncoders(5)
    x = np.linspace(0.0, 30.0, 3001)
    slip = encoders.slip(np.column_stack([x, np.zeros_like(x)]))
    assert slip.min() >= 0.02
    assert slip.max() <= 0.30
    assert (np.ptp(slip, axis=0) > 0.15).all()
    near = np.corrcoef(slip[:-10, 0], slip[10:, 0])[0, 1]
    far = np.corrcoef(slip[:-300, 0], slip[300:, 0])[0, 1]
    assert near > 0.95
    assert abs(far) < 0.6


def test_slip_makes_the_screws_turn_more_than_the_body_moves():
    settings = ScrewSettings(noise=0.0, internal_slip=0.0)
    _, angles = drive(settings, [0.15, 0.0, 0.0])
    assert 1.02 <= forward(angles[-1])[0] / 1.5 <= 1.0 / 0.7


def test_noise_has_its_size_and_none_at_standstill():
    settings = ScrewSettings(slip=(0.0, 0.0), internal_slip=0.0)
    _, moving = drive(settings, [0.15, 0.0, 0.0], n=4000)
    speeds = np.diff(moving, axis=0) * settings.rate
    np.testing.assert_allclose(speeds.std(axis=0), 0.15, rtol=0.05)
    _, standing = drive(settings, [0.0, 0.0, 0.0])
    assert (standing == 0.0).all()
