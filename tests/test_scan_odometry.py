"""Scan matching as odometry: drift shrinks on rough ground, and flat ground and few contacts change nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from drivers.measurement import OdometrySample
from robominer_slam import geometry
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.configuration.robust_slam_section import ScanMatchingSection
from robominer_slam.estimation.robust_odometry import RobustOdometry
from robominer_slam.slam.scan_odometry import ScanOdometry, varying
from tests.touched_ground import MODEL, flat, rough, touches

BIAS = np.array([0.003, 0.006, 0.004])
STEP_NS = 50_000_000
HALF = (0.22, 0.14)
ALONG = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass
class Driven:
    error: float
    bias: np.ndarray
    matches: int


def drive(height, *, matching: bool, seconds: float = 30.0, seed: int = 4) -> Driven:
    """A circle at 0.15 m/s with a biased odometry; contacts of the whole array twenty times a second."""
    rng = np.random.default_rng(seed)
    odometry = RobustOdometry(RobustEstimationSection(), "odometry", None, np.eye(4))
    scans = ScanOdometry(ScanMatchingSection(), MODEL, 0.4)
    true, velocity = np.zeros(3), np.array([0.15, 0.0, 0.1])
    for step in range(round(seconds * 20)):
        stamp = step * STEP_NS
        odometry.add(OdometrySample(stamp, velocity + BIAS + rng.normal(0, 0.01, 3)))
        points = touches(height, rng, 40, HALF, true)
        state = odometry.state_at(stamp)
        if matching:
            covariance = np.zeros((4, 4))
            covariance[:3, :3], covariance[3, 3] = odometry.relative_covariance(), 0.002**2
            predicted = np.array([state.x, state.y, state.yaw, 0.0])
            correction = scans.match(predicted, covariance, points) if scans.moved(*predicted[:3]) else None
            if correction is not None:
                odometry.correct_pose(stamp, correction.offset, correction.information)
                state = odometry.state_at(stamp)
            scans.add(np.array([state.x, state.y, state.yaw, 0.0]), points)
        last = true
        true = geometry.se2_compose(true, geometry.se2_exp(velocity * STEP_NS * 1e-9))
    return Driven(float(np.hypot(state.x - last[0], state.y - last[1])), odometry.bias, scans.matches)


def test_on_rough_ground_the_drift_shrinks_and_the_bias_is_learned():
    alone, matched = drive(rough(0), matching=False), drive(rough(0), matching=True)
    assert alone.error > 0.2
    assert matched.error < 0.4 * alone.error
    assert np.linalg.norm(matched.bias - BIAS) < 0.6 * np.linalg.norm(alone.bias - BIAS)
    assert matched.matches > 150


def test_on_flat_ground_matching_changes_little():
    alone, matched = drive(flat, matching=False), drive(flat, matching=True)
    assert matched.matches > 150
    assert matched.error == pytest.approx(alone.error, abs=0.4 * alone.error)
    assert np.abs(matched.bias - alone.bias).max() < 0.003, "noise of the touches must not be learned as a bias"


def scans_on(height, rng, **changes) -> ScanOdometry:
    """A map of 30 frames around the origin, old enough to be matched with."""
    scans = ScanOdometry(ScanMatchingSection(**{"step": 0.001, "age": 0.0, "rebuild": 0.0, **changes}), MODEL, 0.6)
    for k in range(30):
        pose = np.array([0.002 * k, 0.0, 0.0, 0.0])
        scans.moved(*pose[:3])
        scans.add(pose, touches(height, rng, 60, HALF, pose[:3], noise=4e-4))
    return scans


def test_a_match_tells_the_offset_of_the_prediction_whatever_its_prior():
    rng = np.random.default_rng(0)
    true = np.array([0.06, 0.0, 0.0])
    for sigma in (0.001, 0.02):
        scans = scans_on(rough(1), np.random.default_rng(1), associations=3)
        predicted = np.append(true + np.array([0.006, -0.004, 0.01]), 0.0)
        covariance = np.diag([sigma, sigma, 2 * sigma, 0.002]) ** 2
        correction = scans.match(predicted, covariance, touches(rough(1), rng, 400, HALF, true, noise=4e-4))
        assert correction is not None
        assert correction.offset[:2] == pytest.approx((true - predicted[:3])[:2], abs=0.002)
        assert correction.offset[2] == pytest.approx(true[2] - predicted[2], abs=0.005)
        assert np.linalg.eigvalsh(correction.information)[0] > 0.0


def test_information_counts_for_its_share_only():
    rng, pose = np.random.default_rng(0), np.array([0.06, 0.0, 0.0, 0.0])
    points = touches(rough(1), rng, 100, HALF, pose[:3])
    half, whole = (
        scans_on(rough(1), np.random.default_rng(1), share=share).match(pose, np.eye(4) * 1e-6, points)
        for share in (0.5, 1.0)
    )
    np.testing.assert_allclose(whole.information, 2.0 * half.information, rtol=1e-9)


def test_a_flat_map_gives_matches_next_to_no_information():
    rng, pose = np.random.default_rng(0), np.array([0.06, 0.0, 0.0, 0.0])
    told = []
    for height in (flat, rough(1)):
        for seed in range(10):
            points = touches(height, rng, 60, HALF, pose[:3])
            correction = scans_on(height, np.random.default_rng(seed)).match(pose, np.eye(4) * 1e-4, points)
            told.append(np.linalg.eigvalsh(correction.information)[-1])
    assert np.mean(told[:10]) < 0.001 * np.mean(told[10:])


@pytest.mark.parametrize("turned", np.radians([0.0, 50.0, 200.0]))
def test_heading_does_not_tell_the_way_along_a_corridor(turned):
    """Most of the slopes along it are errors, and so are their products with those that tell the heading."""
    known = np.array([[100.0, 0.0, 60.0], [0.0, 5e4, 0.0], [60.0, 0.0, 500.0]])
    errors = np.diag([900.0, 1e3, 20.0])
    c, s = np.cos(turned), np.sin(turned)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    along, across = R[:, 0], R[:, 1]
    known = R @ known @ R.T
    varies = varying(known, known + R @ errors @ R.T)
    told = varies @ known @ varies
    assert along @ told @ along == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(told @ along, 0.0, atol=1e-6)
    assert across @ told @ across == pytest.approx(5e4)
    assert told[2, 2] == pytest.approx(500.0)


def test_ground_that_varies_everywhere_keeps_what_it_tells():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    known = root @ root.T + np.eye(3)
    np.testing.assert_allclose(varying(known, 1.5 * known), np.eye(3))
    np.testing.assert_allclose(varying(known, 10.0 * known), 0.0, atol=1e-12)


def test_few_contacts_other_ground_and_standing_still_give_no_match():
    rng, pose, covariance = np.random.default_rng(0), np.array([0.06, 0.0, 0.0, 0.0]), np.eye(4) * 1e-6
    points = touches(rough(1), rng, 60, HALF, pose[:3])
    assert scans_on(rough(1), rng).match(pose, covariance, points[:7]) is None
    assert scans_on(rough(1), rng).match(pose + 5.0 * ALONG, covariance, points) is None
    strange = points * [1.0, 1.0, 0.0] + np.column_stack([np.zeros((60, 2)), rng.uniform(-0.1, 0.1, 60)])
    assert scans_on(rough(1), rng).match(pose, covariance, strange) is None
    moving = scans_on(rough(1), rng, step=0.02)
    pose[0] = 0.065
    moving.add(pose, points)
    assert not moving.moved(0.065 + 0.019, 0.0, 0.0)
    assert moving.moved(0.065 + 0.021, 0.0, 0.0)
    assert moving.match(pose + 0.021 * ALONG, covariance, points) is not None


def test_turning_on_the_spot_counts_as_way():
    scans = ScanOdometry(ScanMatchingSection(), MODEL, 0.4)
    for yaw in np.linspace(3.0, 3.0 + 2 * np.pi, 100):
        scans.moved(0.0, 0.0, float(geometry.wrap_angle(yaw)))
    assert scans.travelled == pytest.approx(0.15 * 2 * np.pi, rel=1e-6)
