"""Touches fitted onto a surface: slopes, accuracy, outliers, and what the ground does not tell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robominer_slam import geometry
from robominer_slam.configuration.robust_slam_section import ClosureSection
from robominer_slam.slam.surface import Surface
from robominer_slam.slam.surface_registration import (
    fit,
    fit_each,
    height_left_free,
    placed,
    residual_jacobian,
    slope_noise_information,
)
from tests.touched_ground import MODEL, NOISE, corridor, flat, rough, touches

NO_PRIOR = np.zeros((4, 4))
HALF = (0.22, 0.14)
CLOSURE = ClosureSection()
#: A direction with less information (1/m2, or 1/rad2) is too free for a closure.
FREE = CLOSURE.inflation / CLOSURE.max_sigma**2
FREE_YAW = CLOSURE.inflation / np.deg2rad(CLOSURE.max_sigma_yaw_deg) ** 2
numbers = st.floats(-2.0, 2.0)


def ground(height, seed: int, count: int = 3000, noise: float = NOISE) -> Surface:
    return Surface(touches(height, np.random.default_rng(seed), count, (0.5, 0.5), noise=noise), MODEL)


def match(height, seed: int, guess=(0.0, 0.0, 0.0, 0.0), points=None):
    """Touches at the origin fitted onto touches of the same ground."""
    if points is None:
        points = touches(height, np.random.default_rng(seed + 1000), 300, HALF)
    return fit(ground(height, seed), points, np.array(guess), NO_PRIOR, associations=4)


@given(st.lists(numbers, min_size=4, max_size=4), st.lists(numbers, min_size=2, max_size=2))
def test_residual_jacobian_equals_finite_differences(pose, slope):
    pose, slope = np.array(pose), np.array(slope)
    points = np.random.default_rng(0).normal(0, 0.3, (5, 3))

    def residual(at):
        q = placed(points, at)
        return q[:, 2] - q[:, :2] @ slope

    numeric = np.stack([(residual(pose + e) - residual(pose - e)) / 2e-6 for e in 1e-6 * np.eye(4)])
    np.testing.assert_allclose(
        residual_jacobian(placed(points, pose), pose, np.tile(slope, (5, 1))), numeric, atol=1e-7
    )


def test_noise_of_the_slopes_adds_to_the_information_what_it_is_said_to_add():
    rng = np.random.default_rng(0)
    q, pose, weight = rng.normal(0, 0.2, (40, 3)), np.array([0.1, 0.0, 0.3, 0.0]), rng.uniform(1.0, 2.0, 40)
    noise = np.tile([[4e-4, 1e-4], [1e-4, 1e-4]], (40, 1, 1))
    root = np.linalg.cholesky(noise[0])
    drawn = []
    for _ in range(4000):
        J = residual_jacobian(q, pose, rng.normal(size=(40, 2)) @ root.T)
        drawn.append((J * weight) @ J.T)
    added = slope_noise_information(q, pose, np.array([noise[:, 0, 0], noise[:, 0, 1], noise[:, 1, 1]]), weight)
    np.testing.assert_allclose(np.mean(drawn, axis=0)[:3, :3], added[:3, :3], atol=0.03 * added.max())


def test_a_shifted_patch_is_found_to_a_millimetre():
    truth = np.array([0.03, -0.02, 0.04, 0.005])
    errors = []
    for seed in range(4):
        points = touches(rough(seed), np.random.default_rng(seed + 1000), 1000, HALF, truth[:3], noise=4e-4)
        surface = ground(rough(seed), seed, count=12_500, noise=4e-4)
        found = fit(surface, points - [0.0, 0.0, truth[3]], np.zeros(4), NO_PRIOR, associations=5)
        errors.append(np.abs(found.pose - truth))
        assert found.inliers > 0.97
        assert np.abs(np.linalg.solve(found.curvature, found.gradient)).max() < 1e-4, "nothing pulls at the optimum"
    assert np.mean(errors, axis=0)[[0, 1, 3]].max() < 0.001
    assert np.max(errors, axis=0)[[0, 1, 3]].max() < 0.0015
    assert np.max(errors, axis=0)[2] < 0.004


def test_outliers_do_not_move_it():
    rng = np.random.default_rng(9)
    truth = np.array([0.02, 0.01, 0.0, 0.0])
    points = touches(rough(3), rng, 400, HALF, truth[:3])
    spoilt = points.copy()
    spoilt[::6, 2] += rng.uniform(0.02, 0.05, len(spoilt[::6]))
    clean, found = (match(rough(3), 3, points=p) for p in (points, spoilt))
    assert np.abs(found.pose - clean.pose)[:2].max() < 0.001
    assert found.inliers == pytest.approx(5 / 6, abs=0.03)


def test_flat_ground_tells_nothing_of_x_y_and_heading():
    matches = [match(flat, seed) for seed in range(30)]
    told = np.array([np.linalg.eigvalsh(height_left_free(m.information))[-1] for m in matches])
    unreduced = np.array([np.linalg.eigvalsh(height_left_free(m.curvature))[-1] for m in matches])
    assert told.max() < FREE
    assert told.mean() < 0.1 * unreduced.mean(), "errors of the slopes look like slopes"
    assert min(m.information[3, 3] for m in matches) > 0.001**-2, "but the height is known"


@pytest.mark.parametrize("seed", range(10))
def test_a_corridor_tells_nothing_along_it(seed):
    planar = height_left_free(match(corridor, seed).information)
    assert planar[0, 0] < FREE
    assert planar[1, 1] > 100.0 * FREE
    assert planar[2, 2] > 5.0 * FREE_YAW


def test_the_prior_holds_what_the_ground_leaves_free():
    prior = np.diag(np.array([0.0005, 0.02, 0.02, 0.02]) ** -2.0)
    points = touches(corridor, np.random.default_rng(1), 300, HALF, (0.0, 0.02, 0.0))
    found = fit(ground(corridor, 1), points, np.zeros(4), prior, associations=8)
    assert abs(found.pose[0]) < 0.001
    np.testing.assert_allclose(found.gradient + prior @ found.pose, 0.0, atol=1e-3 * np.abs(found.gradient).max())
    assert found.pose[1] == pytest.approx(0.02, abs=0.001)


def test_touches_beside_the_known_ground_stay_where_they_were_guessed():
    guess = np.array([3.0, 0.0, 0.1, 0.0])
    found = match(rough(0), 0, guess=guess)
    np.testing.assert_array_equal(found.pose, guess)
    assert (found.overlap, found.cost) == (0.0, np.inf)
    assert not found.information.any()


def test_relief_leaves_the_common_tilt_out():
    assert match(lambda x, _: 0.1 * x, 0).relief < 0.001
    assert match(rough(0, relief=0.012), 0).relief == pytest.approx(0.012, rel=0.5)


def test_a_fit_at_a_turned_place_says_the_same_as_at_home():
    """Turning surface and guess turns the answer: no direction is special."""
    points, turn = touches(rough(4), np.random.default_rng(4), 300, HALF), 1.1
    about = ground(rough(4), 4).points
    c, s = np.cos(turn), np.sin(turn)
    turned = Surface(np.column_stack([about[:, :2] @ [[c, s], [-s, c]], about[:, 2]]), MODEL)
    here = fit(Surface(about, MODEL), points, np.zeros(4), NO_PRIOR, 4).pose
    there = fit(turned, points, np.array([0.0, 0.0, turn, 0.0]), NO_PRIOR, 4).pose
    np.testing.assert_allclose(there[:3], geometry.se2_compose(np.array([0.0, 0.0, turn]), here[:3]), atol=1e-9)


def test_several_guesses_at_once_end_where_each_would_alone():
    points = touches(rough(3), np.random.default_rng(7), 300, HALF, noise=4e-4)
    surface = ground(rough(3), 3, noise=4e-4)
    guesses = np.array([[0.01, 0.0, 0.02, 0.0], [9.0, 9.0, 0.0, 0.0], [-0.02, 0.02, -0.03, 0.002]])
    together = fit_each(surface, points, guesses, NO_PRIOR, 3)
    for found, guess in zip(together, guesses, strict=True):
        alone = fit(surface, points, guess, NO_PRIOR, 3)
        np.testing.assert_allclose(found.pose, alone.pose, atol=1e-12)
        np.testing.assert_allclose(found.information, alone.information, rtol=1e-9, atol=1e-6)
        assert (found.overlap, found.inliers, found.cost) == pytest.approx((alone.overlap, alone.inliers, alone.cost))
    assert together[1].overlap == 0.0, "one is lost, and takes no other with it"
    assert np.isinf(together[1].cost)


def test_guesses_on_the_way_to_one_place_are_followed_as_one():
    points = touches(rough(3), np.random.default_rng(7), 300, HALF, noise=4e-4)
    surface = ground(rough(3), 3, noise=4e-4)
    guesses = np.array([[0.01, 0.0, 0.02, 0.0], [0.1, 0.12, 0.4, 0.0], [-0.02, 0.02, -0.03, 0.002]])
    each = fit_each(surface, points, guesses, NO_PRIOR, 3)
    found = fit_each(surface, points, guesses, NO_PRIOR, 3, (0.03, 0.05))
    assert len(found) == 2
    best = min(found, key=lambda match: match.cost)
    assert best.cost == pytest.approx(min(match.cost for match in each), rel=0.01)
    np.testing.assert_allclose(best.pose, np.zeros(4), atol=0.01)
    other = max(found, key=lambda match: match.cost)
    np.testing.assert_allclose(other.pose, each[1].pose, atol=0.02, err_msg="another place is not affected")
