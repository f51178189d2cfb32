"""Heights of a map against a surface that is known, and the covariance against errors that it should tell."""

from __future__ import annotations

import numpy as np
import pytest

from robominer_slam.evaluation.consistency import consistency, mahalanobis2
from robominer_slam.evaluation.height_errors import gentle, height_errors
from robominer_slam.evaluation.metrics import TrajectoryErrors


def slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.2 * x - 0.1 * y


def box(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A box of 5 cm on level ground, x and y from 0 to 0.2 m."""
    return np.where((x > 0) & (x < 0.2) & (y > 0) & (y < 0.2), 0.05, 0.0)


def touches(n: int = 4000, half: float = 0.5, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-half, half, (n, 2))


def test_a_constant_offset_does_not_count():
    xy = touches()
    errors = height_errors(np.column_stack([xy, slope(*xy.T) + 0.123]), slope)
    assert errors is not None
    assert errors.offset_m == pytest.approx(0.123, abs=1e-9)
    assert errors.rms_m < 1e-9
    assert errors.cells == errors.touched


def test_random_errors_per_cell():
    rng = np.random.default_rng(1)
    xy = (np.floor(touches() / 0.02) + 0.5) * 0.02
    cells, index = np.unique(np.floor(xy / 0.02), axis=0, return_inverse=True)
    wrong = rng.normal(0, 0.005, len(cells))[index.reshape(-1)]
    errors = height_errors(np.column_stack([xy, slope(*xy.T) + wrong]), slope)
    assert errors is not None
    assert errors.rms_m == pytest.approx(0.005, rel=0.05)
    assert errors.median_m == pytest.approx(0.6745 * 0.005, rel=0.1)


def test_cells_near_a_step_or_on_a_steep_slope_are_left_out():
    ij = np.array([[4, 4], [1, 4], [0, 4], [-1, 4], [-2, 4], [-3, 4], [-20, 4]])
    # Centres of x at 0.09, 0.03 (exactly 3 cm from the wall), 0.01, -0.01, -0.03, -0.05, -0.39 m.
    found = gentle(ij, box, 0.02)
    assert found.tolist()[0] is True
    assert found.tolist()[2:4] == [False, False]
    assert found.tolist()[5:] == [True, True]
    assert not gentle(ij, lambda x, y: 0.6 * x + 0.0 * y, 0.02).any()
    assert gentle(ij, lambda x, y: 0.55 * x + 0.0 * y, 0.02).all()


def test_errors_on_the_box_wall_do_not_count():
    xy = touches()
    z = box(*xy.T)
    near = np.abs(xy[:, 0]) < 0.012
    z[near & (np.abs(xy[:, 1] - 0.1) < 0.08)] += 0.03
    errors = height_errors(np.column_stack([xy, z]), box)
    assert errors is not None
    assert errors.rms_m < 1e-9
    assert errors.cells < errors.touched


def test_without_cells_there_is_no_error():
    assert height_errors(np.zeros((0, 3)), slope) is None
    assert height_errors(np.array([[0.0, 0.1, 0.0]]), box) is None


def errors_of(components: np.ndarray) -> TrajectoryErrors:
    full = np.zeros((len(components), 6))
    full[:, [0, 1, 5]] = components
    return TrajectoryErrors(np.arange(len(full)), full, np.abs(full[:, 5]))


def test_a_true_covariance_holds_99_percent():
    rng = np.random.default_rng(0)
    root = np.array([[0.05, 0.01, 0.002], [0.0, 0.03, -0.01], [0.0, 0.0, 0.02]])
    covariance = np.broadcast_to(root @ root.T, (20000, 3, 3))
    errors = errors_of(rng.normal(size=(20000, 3)) @ root.T)
    found = consistency(errors, covariance)
    assert found.share_within_99 == pytest.approx(0.99, abs=0.003)
    np.testing.assert_allclose(mahalanobis2(errors, covariance).mean(), 3.0, rtol=0.05)
    assert consistency(errors, covariance / 16.0).share_within_99 < 0.6
    assert consistency(errors, 16.0 * covariance).sigma_ratio == pytest.approx(4.0 * found.sigma_ratio)


def test_a_covariance_of_zero_is_no_error():
    found = consistency(errors_of(np.zeros((3, 3))), np.zeros((3, 3, 3)))
    assert (found.share_within_99, found.sigma_ratio) == (1.0, None)
