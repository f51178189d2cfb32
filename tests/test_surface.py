"""The surface through touches: heights and slopes, what is unknown, and how sure it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robominer_slam.slam.surface import LEAST_NEIGHBOURS, Surface
from tests.touched_ground import MODEL, flat, rough, touches


def test_a_plane_is_found_with_its_slope_wherever_its_heights_are_counted_from():
    points = touches(lambda x, y: 0.1 * x - 0.05 * y, np.random.default_rng(0), 600, (0.2, 0.2), noise=0.0)
    places = np.array([[0.0, 0.0], [0.1, -0.05]])
    for datum in (0.0, 1000.0):
        found = Surface(points + np.array([0.0, 0.0, datum]), MODEL).at(places)
        np.testing.assert_allclose(found.height - datum, 0.1 * places[:, 0] - 0.05 * places[:, 1], atol=3e-4)
        np.testing.assert_allclose(found.slope, [[0.1, -0.05]] * 2, atol=0.01)


def test_nothing_is_known_beyond_reach_or_by_too_few_touches():
    points = touches(flat, np.random.default_rng(0), 400, (0.2, 0.2))
    found = Surface(points, MODEL).at(np.array([[0.0, 0.0], [0.5, 0.0]]))
    assert found.known.tolist() == [True, False]
    few = np.array([[0.001 * k, 0.0, 0.0] for k in range(LEAST_NEIGHBOURS - 1)])
    far = np.array([[1.0 + k, 1.0, 0.0] for k in range(5)])
    assert not Surface(np.concatenate([few, far]), MODEL).at(np.zeros((1, 2))).known.any()
    assert not Surface(np.zeros((0, 3)), MODEL).at(np.zeros((3, 2))).known.any()


def test_between_lines_of_touches_the_slope_across_is_left_to_the_prior_and_the_height_is_less_sure():
    x = np.linspace(-0.1, 0.1, 60)
    points = np.concatenate([np.column_stack([x, np.full(60, y), 0.2 * x]) for y in (0.0, 0.08)])
    on, beside = (Surface(points, MODEL).at(np.array([[0.0, y]])) for y in (0.0, 0.03))
    assert on.slope[0] == pytest.approx([0.2, 0.0], abs=0.01)
    assert on.slope_noise[2, 0] < 1e-6, "the prior is no noise of touches"
    assert beside.variance[0] > 2.0 * on.variance[0]


def test_at_a_step_the_surface_counts_for_little():
    rng = np.random.default_rng(0)
    step = Surface(touches(lambda x, _: 0.03 * (x > 0), rng, 800, (0.2, 0.2)), MODEL)
    at_step, beside = step.at(np.array([[0.0, 0.0], [0.15, 0.0]])).variance
    assert at_step > 2.5 * beside


def test_slope_noise_is_the_covariance_of_the_slopes_that_noisy_touches_make():
    rng = np.random.default_rng(1)
    model = replace(MODEL, curvature=0.0)
    clean = touches(flat, rng, 300, (0.12, 0.12), noise=0.0)
    slopes, said = [], []
    for _ in range(400):
        points = clean + np.column_stack([np.zeros((300, 2)), rng.normal(0, model.touch_sigma, 300)])
        found = Surface(points, model).at(np.array([[0.01, 0.02]]))
        slopes.append(found.slope[0])
        said.append(found.slope_noise[[[0, 1], [1, 2]], 0])
    np.testing.assert_allclose(np.mean(said, axis=0), np.cov(np.transpose(slopes)), atol=2e-4)


def test_the_variance_covers_the_error_of_the_height_on_rough_ground():
    height, rng = rough(2), np.random.default_rng(2)
    places = rng.uniform(-0.2, 0.2, (300, 2))
    found = Surface(touches(height, rng, 900, (0.25, 0.25), noise=MODEL.touch_sigma), MODEL).at(places)
    new = height(places[:, 0], places[:, 1]) + rng.normal(0, MODEL.touch_sigma, 300)
    normalised = (new - found.height)[found.known] / np.sqrt(found.variance[found.known])
    assert 0.7 < np.std(normalised) < 1.2
