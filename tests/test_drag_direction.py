"""Whiskers that trail: what their directions say, on made-up tips and on the recordings."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from calibration.angle_estimator import AngleEstimator
from drivers.measurement import HallFrame
from drivers.recording_reader import Recording
from robominer_slam import layout as layouts
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import ContactModel, Contacts
from robominer_slam.estimation.cross_slope import CrossSlope
from robominer_slam.estimation.drag_direction import DragDirection
from robominer_slam.replay import prepare

RECORDINGS = Path(__file__).parent / "recordings"
LAYOUT = layouts.thesis_grid()
FRAME_NS = 40_000_000


def trailing(velocity, layout=LAYOUT, inclination=0.6, noise=0.0, rng=None) -> Contacts:
    """Contacts of rods in steady motion: each points against the motion of its own tip."""
    vx, vy, wz = velocity
    reach = layout.length * math.sin(inclination)
    p = layout.p_base[:, :2].copy()
    for _ in range(20):
        swept = np.stack([vx - wz * p[:, 1], vy + wz * p[:, 0]], axis=1)
        swept /= np.linalg.norm(swept, axis=1)[:, None]
        p = layout.p_base[:, :2] - reach[:, None] * swept
    angle = np.arctan2(-swept[:, 1], -swept[:, 0])
    if rng is not None:
        angle = angle + rng.normal(0.0, noise, len(angle))
    rod = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # Whisker frames have x forward, y right.
    azimuth = np.arctan2(-rod[:, 1], rod[:, 0])
    n = layout.count
    points = np.column_stack([layout.p_base[:, :2] + reach[:, None] * rod, np.full(n, -0.12)])
    rods = np.column_stack([reach[:, None] * rod, np.full(n, -0.12)]).T
    return Contacts(points, np.arange(n), np.full(n, inclination), azimuth, rods)


def measure(true_velocity, estimate, frames=60, noise=0.0, layout=LAYOUT):
    drag = DragDirection(RobustEstimationSection(), layout)
    rng = np.random.default_rng(2)
    P = np.diag([0.02, 0.02, 0.05]) ** 2
    found = []
    for k in range(frames):
        contacts = trailing(true_velocity, layout, noise=noise, rng=rng)
        one = drag.measure(k * FRAME_NS, contacts, np.array(estimate), P)
        if one is not None:
            found.append(one)
    return found, P


def test_right_velocity_needs_no_correction_and_no_frame_tells_the_speed():
    velocity = np.array([0.14, 0.03, 0.05])
    found, _ = measure(velocity, velocity)
    assert len(found) > 4
    np.testing.assert_allclose(found[-1].information @ velocity, 0.0, atol=1e-3 * np.trace(found[-1].information))
    np.testing.assert_allclose(found[-1].vector, 0.0, atol=1e-6 * np.trace(found[-1].information))


def test_sideways_slip_and_turn_are_seen():
    velocity = np.array([0.15, 0.02, 0.03])
    estimate = np.array([0.15, 0.0, 0.0])
    found, P = measure(velocity, estimate)
    information = sum(one.information for one in found)
    after = estimate + np.linalg.solve(np.eye(3) + P @ information, P @ sum(one.vector for one in found))
    assert after[:2] == pytest.approx(velocity[:2], abs=0.004)
    assert after[2] == pytest.approx(velocity[2], abs=0.012)


def test_compressed_rows_say_the_same():
    found, _ = measure([0.15, 0.02, 0.05], [0.15, 0.0, 0.0])
    H, innovation = found[-1].compressed()
    np.testing.assert_allclose(H.T @ H, found[-1].information, atol=1e-5 * np.trace(found[-1].information))
    np.testing.assert_allclose(
        H.T @ innovation, found[-1].vector, rtol=1e-3, atol=1e-3 * np.abs(found[-1].vector).max()
    )


def test_information_grows_with_the_way_not_with_the_frames():
    slow, _ = measure([0.05, 0.0, 0.0], [0.05, 0.0, 0.0], frames=240)
    fast, _ = measure([0.15, 0.0, 0.0], [0.15, 0.0, 0.0], frames=80)
    # An angle is as well known at any speed, so the sideways velocity is by the square of the speed.
    told = [sum(one.information[1, 1] for one in found) for found in (slow, fast)]
    assert told[0] * 0.05**2 == pytest.approx(told[1] * 0.15**2, rel=0.3)


def test_a_still_robot_gives_nothing():
    found, _ = measure([0.15, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert not found


def test_whiskers_for_walls_do_not_count():
    layout = layouts.rm3()
    found, _ = measure([0.15, 0.0, 0.0], [0.15, 0.0, 0.0], layout=layout)
    assert found[-1].tips == 48


def test_slopes_of_a_plane_are_found():
    floor = np.ones(LAYOUT.count, dtype=np.bool_)
    contacts = trailing([0.15, 0.0, 0.0])
    points = contacts.points.copy()
    points[:, 2] = 0.1 * points[:, 0] - 0.2 * points[:, 1]
    slopes = CrossSlope(LAYOUT, floor)
    gradient = slopes.gradient(points, contacts.index, np.arange(64))
    np.testing.assert_allclose(gradient, [[0.1] * 64, [-0.2] * 64], atol=0.02)
    # Whiskers that do not touch are left out, and so are those that point elsewhere.
    points[::3, 2] += 1.0
    touching = np.flatnonzero(np.arange(64) % 3)
    few = slopes.gradient(points[touching], contacts.index[touching], np.arange(1, 42, 2))
    np.testing.assert_allclose(few, [[0.1] * 21, [-0.2] * 21], atol=0.03)
    elsewhere = CrossSlope(LAYOUT, np.arange(64) % 3 > 0).gradient(points, contacts.index, touching[1:42:2])
    np.testing.assert_allclose(elsewhere, few, atol=0.001)


def test_the_array_shows_the_direction_on_a_recorded_drive():
    """Scenario 1, straight parts: the direction without bias, within some degrees; from the true velocity."""
    path = RECORDINGS / "scenario-1.mcap"
    inputs = prepare(path, None)
    truth = {t.stamp_ns: t.twist for _, t in Recording(path).ground_truth()}
    angles = AngleEstimator(inputs.model)
    contacts = ContactModel(inputs.layout, math.radians(4.0), math.radians(70.0))
    drag = DragDirection(RobustEstimationSection(), inputs.layout)
    side = []
    for _, frame in inputs.recording:
        if not isinstance(frame, HallFrame):
            continue
        twist = truth[frame.stamp_ns]
        velocity = twist[[0, 1, 5]]
        found = angles.angles(frame.field_mT, frame.valid)
        touching = contacts.contacts(found, found.valid)
        one = drag.measure(frame.stamp_ns, touching, velocity, np.diag([1e-8, 0.05, 0.3]) ** 2)
        if one is not None and abs(velocity[2]) < 0.02:
            left = np.array([-one.ahead[1], one.ahead[0]])
            P = np.diag([0.05, 0.05, 0.3]) ** 2
            correction = np.linalg.solve(np.eye(3) + 1e4 * P @ one.information, 1e4 * P @ one.vector)
            side.append(math.degrees(math.atan2(left @ correction[:2], np.hypot(*velocity[:2]))))
    assert len(side) > 400
    assert abs(np.mean(side)) < 1.0
    assert np.std(side) < 4.0
