"""Rest positions that drift are followed while nothing touches, and never while something may."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.angle_estimator import AngleEstimator
from calibration.fit import JigSamples, fit_jig
from robominer_slam.configuration.model import HealthSection
from robominer_slam.layout import thesis_grid
from robominer_slam.rest_tracking import RestTracker
from robominer_slam.whisker_health import WhiskerState
from sim_backend.hall_drift import DriftSettings, HallDrift
from tests.test_calibration import jig_rows

FRAME_NS = 40_000_000
SPEED = 0.15
ONES = np.ones(64, dtype=bool)


@pytest.fixture(scope="module")
def model():
    rows = jig_rows(np.random.default_rng(0), [(r, c) for r in range(8) for c in range(8)], noise=0.0)
    return fit_jig(JigSamples.from_rows(rows), 8, 8).model


def path(seconds, turn_every=20.0, reversing=False):
    """Poses of a robot that drives at 0.15 m/s, turning left by a quarter, or driving back, from time to time."""
    x = y = 0.0
    for k in range(round(seconds * 25)):
        leg = k // round(25 * turn_every)
        yaw = 0.0 if reversing else np.pi / 2 * leg
        step = SPEED * 0.04 * (-1.0 if reversing and leg % 2 else 1.0)
        x, y = x + step * np.cos(yaw), y + step * np.sin(yaw)
        yield k * FRAME_NS, (x, y, yaw)


def feed(tracker, inclination, azimuth, seconds, *, noise_deg=0.3, turn_every=20.0, motion=1.0):
    """Constant tilts with noise; returns the sum of the shifts in degrees."""
    rng = np.random.default_rng(1)
    total = np.zeros((2, 64))
    for stamp, (x, y, yaw) in path(seconds, turn_every):
        tilt = np.deg2rad(inclination) * np.array([np.cos(azimuth), np.sin(azimuth)])[:, None]
        tilt = tilt + rng.normal(0.0, np.deg2rad(noise_deg), (2, 64))
        inc, az = np.hypot(*tilt), np.arctan2(tilt[1], tilt[0])
        shift = tracker.update(stamp, ONES, inc, az, (x * motion, y * motion, yaw))
        if shift is not None:
            total += shift
    return np.rad2deg(total)


def test_drift_of_free_rods_is_followed_and_the_angles_stay_right(model):
    """Ten minutes of four times the robot's drift: the offsets wander by a degree and more, the estimates do not.

    The robot drives ahead and back: what drifts to where a dragged tip would trail is followed on the way back.
    """
    tracker, followed, fixed = RestTracker(HealthSection(), thesis_grid()), AngleEstimator(model), AngleEstimator(model)
    drift = HallDrift(3, 64, DriftSettings(offset_walk=0.02))
    rng = np.random.default_rng(2)
    errors, errors_fixed = [], []
    for stamp, (x, y, yaw) in path(600.0, reversing=True):
        drifted = drift.apply(model.rest_mT, 0.04)
        reading = np.round((drifted + rng.normal(0.0, 0.12, (64, 3))) / 0.098) * 0.098
        angles = followed.angles(reading, ONES)
        shift = tracker.update(stamp, angles.valid, angles.inclination, angles.azimuth, (x, y, yaw))
        if shift is not None:
            followed.shift_rest(shift)
        if stamp > 300_000_000_000 and stamp % 1_000_000_000 == 0:
            errors.append(followed.angles(drifted, ONES).inclination)
            errors_fixed.append(fixed.angles(drifted, ONES).inclination)
    rms, rms_fixed = (np.rad2deg(np.sqrt(np.mean(np.square(e)))) for e in (errors, errors_fixed))
    assert rms_fixed > 0.8
    assert rms < 0.6 * rms_fixed


def test_a_tip_dragged_over_flat_ground_is_never_rest():
    """Its reading is constant as well: at 12 degrees far from rest, and at 1 degree near it, but trailing."""
    for inclination in (12.0, 1.0):
        tracker = RestTracker(HealthSection(), thesis_grid())
        # Whisker frames have x forward: trailing is azimuth pi, in whatever direction the body has turned.
        assert not feed(tracker, inclination, np.pi, 60.0).any()
        assert (tracker.state == WhiskerState.OK).all()


def test_nothing_is_zeroed_while_the_robot_stands():
    tracker = RestTracker(HealthSection(), thesis_grid())
    assert not feed(tracker, 1.0, 0.5, 30.0, motion=0.0).any()


def test_a_small_offset_is_zeroed_slowly():
    tracker = RestTracker(HealthSection(), thesis_grid())
    total = feed(tracker, 1.0, 0.5, 30.0)
    # 0.01 degrees a second, no faster.
    assert np.hypot(*total).max() <= 0.3 + 1e-9
    assert np.hypot(*total).mean() > 0.2
    np.testing.assert_allclose(np.arctan2(total[1], total[0]), 0.5, atol=0.5)


def test_a_restless_reading_is_no_rest():
    tracker = RestTracker(HealthSection(), thesis_grid())
    assert not feed(tracker, 0.0, 0.0, 30.0, noise_deg=2.5).any()


def test_a_bent_rod_keeps_its_tilt_whichever_way_the_robot_drives():
    tracker = RestTracker(HealthSection(), thesis_grid())
    rng = np.random.default_rng(0)
    states = []
    for k in range(25 * 20):
        # Holonomic: the body keeps its heading and drives ahead, then to the left.
        d = SPEED * 0.04 * k
        pose = (min(d, 1.5), max(0.0, d - 1.5), 0.0)
        tilt = np.deg2rad(rng.normal(0.0, 0.3, (2, 64)))
        tilt[0, 20] += np.deg2rad(6.0)
        # One that trails: it turns with the motion (y of the whisker frames points right).
        tilt[:, 30] += np.deg2rad(6.0) * np.array([-1.0, 0.0] if d < 1.5 else [0.0, 1.0])
        inc, az = np.hypot(*tilt), np.arctan2(tilt[1], tilt[0])
        tracker.update(k * FRAME_NS, ONES, inc, az, pose)
        states.append(tracker.state.copy())
    assert not states[200].any()
    assert np.flatnonzero(states[-1]).tolist() == [20]
    assert states[-1][20] == WhiskerState.BENT


def test_a_rest_position_that_has_crept_too_far_is_drifting():
    tracker = RestTracker(HealthSection(rest_rate=1.0, drift_deg=1.0), thesis_grid())
    feed(tracker, 1.5, 0.5, 20.0)
    assert (tracker.state == WhiskerState.DRIFTING).all()
    tracker.reset()
    assert (tracker.state == WhiskerState.OK).all()
