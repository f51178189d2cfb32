"""The search over a whole window: its costs against sums made one by one, far places, heights, overlap."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import irfft2

from robominer_slam.slam import correlative_search
from robominer_slam.slam.correlative_search import SearchGrid, grid_around, grid_within, headings, search, turned
from tests.touched_ground import flat, rough, touches

CELL = 0.02
YAW_STEP = np.deg2rad(4.0)


def searched(target, points, centre, half_window, *, overlap=0.4, prior=1e-6, count=4, yaw_step=YAW_STEP):
    reach = np.hypot(points[:, 0], points[:, 1]).max() + np.asarray(half_window)[:2] + 3 * CELL
    centre = np.array(centre, dtype=float)
    grid = SearchGrid(target, *grid_around(centre[:2] - reach, centre[:2] + reach, CELL), CELL)
    return grid, search(grid, points, centre, np.array(half_window), yaw_step, overlap, prior, count)


def cost_one_by_one(grid: SearchGrid, points, centre, shift, yaw, prior) -> tuple[float, int]:
    """Mean squared difference and touches on known cells: touches are put into cells at the centre, then shifted."""
    height = irfft2(grid.fft_height, s=grid.shape)
    c, s = np.cos(yaw), np.sin(yaw)
    square_sum = plain_sum = 0.0
    on_known = 0
    for x, y, z in points:
        at = np.array([c * x - s * y, s * x + c * y]) + centre - grid.origin
        i, j = np.floor(at / CELL).astype(int) + shift
        if grid.known[i, j]:
            difference = z - grid.datum - height[i, j]
            square_sum, plain_sum, on_known = square_sum + difference**2, plain_sum + difference, on_known + 1
    return (square_sum - plain_sum**2 / (on_known + prior)) / on_known, on_known


def test_every_cost_equals_the_sum_made_one_by_one():
    rng = np.random.default_rng(0)
    target = touches(rough(0), rng, 500, (0.2, 0.15))
    points = touches(rough(0), rng, 40, (0.08, 0.06), (0.02, 0.01, 0.1))
    centre, half, prior, step = np.array([0.01, 0.0, 0.05]), (0.06, 0.04, 0.1), 3.0, 0.05
    grid, found = searched(target, points, centre, half, prior=prior, count=1, yaw_step=step)
    costs = {}
    for turn in range(-2, 3):
        for i in range(-3, 4):
            for j in range(-2, 3):
                cost, known = cost_one_by_one(grid, points, centre[:2], [i, j], centre[2] + turn * step, prior)
                costs[i, j, turn] = cost if known >= 0.4 * len(points) else np.inf
    (i, j, turn), least = min(costs.items(), key=lambda item: item[1])
    np.testing.assert_allclose(found.poses[0], centre + np.array([i * CELL, j * CELL, turn * step]), atol=1e-12)
    assert found.cost[0] == pytest.approx(least, rel=1e-4)
    for turn in range(-2, 3):
        alone = (0.0, 0.0, 0.0)
        grid, found = searched(target, points, [*centre[:2], centre[2] + turn * step], alone, prior=prior)
        expected = cost_one_by_one(grid, points, centre[:2], [0, 0], centre[2] + turn * step, prior)[0]
        assert found.cost[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_a_place_half_a_metre_and_30_degrees_away_is_found(seed):
    rng = np.random.default_rng(seed)
    truth = np.array([0.5, -0.4, 0.52])
    target = touches(rough(seed), rng, 12_000, (1.1, 1.1))
    points = touches(rough(seed), rng, 400, (0.25, 0.2), truth)
    found = searched(target, points, [0.0, 0.0, 0.0], (0.7, 0.7, 0.7))[1]
    assert np.abs(found.poses[0] - truth)[:2].max() <= 0.03
    assert abs(found.poses[0] - truth)[2] <= np.deg2rad(4.0)
    assert found.cost[1] > 1.5 * found.cost[0]
    assert found.overlap[0] > 0.95


def test_a_common_height_is_free_without_a_prior_and_costs_with_one():
    rng = np.random.default_rng(1)
    target, points = touches(rough(1), rng, 3000, (0.5, 0.5)), touches(rough(1), rng, 200, (0.2, 0.2))
    raised = points + np.array([0.0, 0.0, 0.05])
    nothing = (0.0, 0.0, 0.0)
    level, free = (searched(target, p, nothing, nothing, prior=0.0)[1].cost[0] for p in (points, raised))
    assert free == pytest.approx(level, rel=1e-4)
    held = searched(target, raised, nothing, nothing, prior=200.0)[1].cost[0]
    # Half of 5 cm stays: with as much weight as all touches, the prior halves what the sum takes off.
    assert held == pytest.approx(level + 0.05**2 / 2, rel=0.15)


def test_places_off_the_touched_ground_do_not_count():
    rng = np.random.default_rng(2)
    target, points = touches(rough(2), rng, 2000, (0.3, 0.3)), touches(rough(2), rng, 200, (0.2, 0.2))
    assert len(searched(target, points, (1.0, 0.0, 0.0), (0.1, 0.1, 0.1))[1].poses) == 0
    found = searched(target, points, (0.3, 0.0, 0.0), (0.4, 0.1, 0.1), overlap=0.9, count=20)[1]
    assert found.overlap.min() >= 0.9
    assert np.abs(found.poses[:, 0]).max() < 0.2


def test_alternatives_are_other_places():
    rng = np.random.default_rng(3)
    target, points = touches(flat, rng, 3000, (0.6, 0.6)), touches(flat, rng, 100, (0.1, 0.1))
    found = searched(target, points, (0.0, 0.0, 0.0), (0.3, 0.3, 0.1))[1]
    assert len(found.poses) == 4
    for k, pose in enumerate(found.poses):
        for other in found.poses[:k]:
            assert np.hypot(*(pose - other)[:2]) > 0.06 or abs(pose - other)[2] > 0.1
    assert np.all(np.diff(found.cost) >= 0.0)


def test_headings_one_by_one_on_a_part_of_the_grid_give_the_same_places(monkeypatch):
    rng = np.random.default_rng(4)
    target, points = touches(rough(4), rng, 3000, (0.5, 0.5)), touches(rough(4), rng, 200, (0.1, 0.1), (0.1, 0.1, 0.0))
    centre, half = np.array([0.05, 0.1, 0.02]), np.array([0.1, 0.1, 0.2])
    whole = searched(target, points, centre, half)[1]
    xy = turned(points, headings(centre[2], half[2], YAW_STEP)) + centre[:2]
    margin = half[:2] + 4.0 * CELL
    reach = np.hypot(points[:, 0], points[:, 1]).max() + half[:2] + 3 * CELL
    corners = xy.min(axis=(0, 1)) - margin, xy.max(axis=(0, 1)) + margin
    grid = SearchGrid(target, *grid_within(centre[:2] - reach, corners, CELL), CELL)
    monkeypatch.setattr(correlative_search, "CELLS_AT_ONCE", 1)
    part = search(grid, points, centre, half, YAW_STEP, 0.4, 1e-6)
    np.testing.assert_allclose(part.poses, whole.poses, atol=1e-12)
    np.testing.assert_allclose(part.cost, whole.cost, rtol=1e-4)
    np.testing.assert_array_equal(part.overlap, whole.overlap)
