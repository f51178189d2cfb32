"""The physical whisker model: its field, its Jacobians, its inversion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.compiled import compile_physical, direction_error_squared
from calibration.magnet_model import COUNT, MagnetModel, NominalWhisker, fold
from calibration.neighbours import neighbour_matrix
from calibration.physical_fit import PaddedSamples, PhysicalFit, PhysicalFitter, observe
from calibration.polynomial import PolynomialEvaluator, PolynomialModel, tilt_from_angles
from robominer_slam.layout import thesis_grid
from sim_backend.magnet import HallArray, Tolerances
from sim_backend.physics import hinge_angles

NOMINAL = NominalWhisker()
PERFECT = Tolerances(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def whiskers(seed: int, count: int = 3) -> np.ndarray:
    drawn = np.random.default_rng(seed).normal(0.0, 1.0, (count, COUNT))
    # Magnets of one make, and a sane world: 5 % strength, 0.05 mT of Earth.
    drawn[:, 6] *= 0.15
    drawn[:, 13:] *= 0.2
    return NOMINAL.mean() + np.clip(drawn, -2.5, 2.5) * NOMINAL.spread()


def samples_of(field: np.ndarray, tilt: np.ndarray, **keys: bool) -> PaddedSamples:
    inclination, azimuth = np.hypot(tilt[..., 0], tilt[..., 1]), np.arctan2(tilt[..., 1], tilt[..., 0])
    sigma = np.full(inclination.shape, 0.002)
    return PaddedSamples(field, inclination, sigma, azimuth, sigma, np.ones(inclination.shape), **keys)


def test_the_model_has_the_field_of_the_exact_cylinder():
    layout = thesis_grid()
    hall = HallArray(layout, 1, tolerances=PERFECT)
    rest = hall.jig_field(np.zeros((64, 2)))
    for inclination, azimuth in ((0.4, 1.0), (0.9, -2.0), (1.3, 3.0)):
        tilt = tilt_from_angles(np.array(inclination), np.array(azimuth))
        hinge = np.broadcast_to(hinge_angles(np.array(inclination), np.array(azimuth)), (64, 2))
        exact = (hall.jig_field(hinge) - rest)[0]
        model = MagnetModel(NOMINAL, np.ones(1))
        nominal = NOMINAL.mean()[None, :]
        found = model.field(nominal, tilt[None, None]) - model.field(nominal, np.zeros((1, 1, 2)))
        assert np.abs(found[0, 0] - exact).max() < 0.03


@pytest.mark.parametrize(("direction_only", "folded"), [(False, False), (True, False), (False, True), (True, True)])
def test_jacobians_equal_finite_differences(direction_only: bool, folded: bool):
    parameters = whiskers(4)
    tilt = np.random.default_rng(1).uniform(-0.9, 0.9, (3, 5, 2))
    model = MagnetModel(NOMINAL, np.array([1.0, -1.0, 1.0]))
    field, by_parameter, by_tilt = model.linearised(parameters, tilt)
    samples = samples_of(field, tilt, direction_only=direction_only, folded=folded)
    _, (by_parameter, by_tilt), _ = observe(field, [by_parameter, by_tilt], samples)

    def seen(p: np.ndarray, t: np.ndarray) -> np.ndarray:
        return observe(model.field(p, t), [], samples)[0]

    step = 1e-4
    for k in range(COUNT):
        move = np.eye(COUNT)[k] * step
        difference = (seen(parameters + move, tilt) - seen(parameters - move, tilt)) / (2 * step)
        np.testing.assert_allclose(by_parameter[..., k], difference, rtol=2e-3, atol=2e-3)
    for k in range(2):
        move = np.eye(2)[k] * step
        difference = (seen(parameters, tilt + move) - seen(parameters, tilt - move)) / (2 * step)
        np.testing.assert_allclose(by_tilt[..., k], difference, rtol=2e-3, atol=2e-2)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), reverse=st.booleans())
def test_the_live_polynomial_inverts_the_field_from_0_to_75_degrees(seed: int, reverse: bool):
    parameters = whiskers(seed)
    polarity = np.array([1.0, -1.0, -1.0 if reverse else 1.0])
    model = MagnetModel(NOMINAL, polarity)
    rng = np.random.default_rng(seed)
    tilt = tilt_from_angles(np.deg2rad(rng.uniform(0.0, 75.0, (3, 40))), rng.uniform(-np.pi, np.pi, (3, 40)))
    tilt[:, 0] = 0.0
    fit = PhysicalFit(parameters, np.zeros((3, COUNT, COUNT)), tilt, np.full(3, 0.123), np.zeros((3, 40)))
    compiled = compile_physical(model, fit, "Cartesian", folded=False)
    live = PolynomialModel(
        5, compiled.rest_mT, compiled.coefficients, compiled.sigma, np.full(3, 1.3), np.ones(3, dtype=bool)
    )
    field = model.field(parameters, tilt)
    evaluator = PolynomialEvaluator(live)
    found = np.stack([evaluator.tilt(field[:, k]).T for k in range(40)], axis=1)
    error = np.rad2deg(np.sqrt(direction_error_squared(found, tilt)))
    # Beside 0.5 deg of noise; tolerances up to 2.5 sigma all at once.
    assert np.sqrt(np.mean(error**2)) < 0.35
    assert error[:, 0].max() < 0.35
    fitter = PhysicalFitter(model, samples_of(field, tilt))
    exact = fitter.invert(parameters, found, steps=6)
    assert np.rad2deg(np.sqrt(direction_error_squared(exact, tilt))).max() < 0.01


def test_the_neighbours_matrix_is_the_simulators():
    layout = thesis_grid()
    hall = HallArray(layout, 1, tolerances=PERFECT)
    rng = np.random.default_rng(2)
    inclination, azimuth = rng.uniform(0.1, 1.1, 64), rng.uniform(-np.pi, np.pi, 64)
    hinge = hinge_angles(inclination, azimuth)
    change = (hall.field(hinge, np.eye(3)) - hall.jig_field(hinge)).reshape(-1)
    direction = np.stack(
        [np.sin(inclination) * np.cos(azimuth), np.sin(inclination) * np.sin(azimuth), np.cos(inclination) - 1.0], -1
    )
    parameters = np.tile(NOMINAL.mean(), (64, 1))
    model = MagnetModel(NOMINAL, np.ones(64))
    matrix = neighbour_matrix(layout.p_base, layout.R_base_whisker, model, parameters)
    assert np.abs(change).max() > 0.1
    assert np.abs(matrix @ direction.reshape(-1) - change).max() < 0.01


def test_folding_negates_what_has_a_negative_z():
    field = np.array([[1.0, 2.0, 3.0], [1.0, 2.0, -3.0]])
    np.testing.assert_array_equal(fold(field), [[1.0, 2.0, 3.0], [-1.0, -2.0, 3.0]])
