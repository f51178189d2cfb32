"""Calibration of a whole simulated array from jig, rings and floor: accuracy, honesty, robustness, refusals."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.angle_estimator import BLOCKS, AngleEstimator
from calibration.file_format import CalibrationFileError, check_fits, from_text, to_text
from calibration.fit import FitError, FitReport, FloorFrames, JigSamples, fit_array
from calibration.magnet_model import fold
from calibration.polynomial import PolynomialModel
from robominer_slam.layout import WhiskerLayout, thesis_grid
from sim_backend.floor_capture import floor_capture
from sim_backend.jig import jig_sweep, ring_sweep
from sim_backend.magnet import HallArray
from sim_backend.physics import hinge_angles, rod_direction

ALL = np.ones(12, dtype=bool)
R_LEVEL = np.eye(3)[None]


@cache
def block() -> WhiskerLayout:
    """A corner of the thesis's grid, 3 x 4: the same pitch and the same neighbours."""
    whole = thesis_grid()
    kept = [r * 8 + c for r in range(3) for c in range(4)]
    return WhiskerLayout(
        "block", 3, 4, whole.p_base[kept], whole.R_base_whisker[kept], whole.length[kept], whole.present[kept]
    )


@cache
def jig(seed: int = 1) -> JigSamples:
    rows = jig_sweep(block(), seed, inclinations_deg=range(0, 71, 10), azimuths_deg=range(-160, 181, 20))
    return JigSamples.from_rows(rows.tolist())


@cache
def floor(seed: int = 1) -> FloorFrames:
    return floor_capture(block(), seed)


@cache
def fitted(source: str) -> FitReport:
    samples = {"jig": jig, "floor": floor, "rings": lambda: ring_sweep(block(), 1)}[source]()
    return fit_array([samples], block())


def errors(
    model: PolynomialModel, *, seed: int = 1, largest: float = 45.0, folded: bool = False, frames: int = 60
) -> tuple[np.ndarray, np.ndarray]:
    """Error and stated sigma, deg, at random poses of all whiskers and random headings; noise and quantisation."""
    hall, rng, n = HallArray(block(), seed), np.random.default_rng(9), block().count
    inclination = np.arccos(rng.uniform(np.cos(np.deg2rad(largest)), 1.0, (frames, n)))
    hinge = hinge_angles(inclination, rng.uniform(-np.pi, np.pi, (frames, n)))
    turn = np.zeros((frames, 3))
    turn[:, 2] = rng.uniform(-np.pi, np.pi, frames)
    field = hall.sample(hall.field(hinge, Rotation.from_rotvec(turn).as_matrix()), rng)
    estimator = AngleEstimator(model)
    found, sigma = [], []
    for frame, truth in zip(fold(field) if folded else field, rod_direction(hinge), strict=True):
        a = estimator.angles(frame, np.ones(n, dtype=bool))
        assert a.valid.all()
        s = np.sin(a.inclination)
        d = np.stack([s * np.cos(a.azimuth), s * np.sin(a.azimuth), np.cos(a.inclination)], axis=-1)
        np.testing.assert_allclose(a.direction.T, d, atol=1e-12)
        found.append(2.0 * np.arcsin(np.linalg.norm(d - truth, axis=-1) / 2.0))
        sigma.append(estimator.sigma(a.inclination))
    return np.rad2deg(found), np.rad2deg(sigma)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(("source", "limit_rms", "limit_95"), [("jig", 0.5, 1.0), ("floor", 1.0, 2.0)])
def test_the_direction_is_right_within_the_target(source: str, limit_rms: float, limit_95: float):
    error, _ = errors(fitted(source).model)
    assert rms(error) <= limit_rms
    assert np.quantile(error, 0.95) <= limit_95


@pytest.mark.parametrize("source", ["jig", "floor", "rings"])
def test_the_stated_uncertainty_is_honest(source: str):
    error, sigma = errors(fitted(source).model, largest=65.0)
    # Two components: 98 % of the errors lie within twice the RMS.
    assert 0.93 <= np.mean(error < 2.0 * sigma) <= 0.998
    assert 0.8 <= rms(error / sigma) <= 1.25


def test_rings_fix_the_inclination_and_the_operators_touches_the_azimuth():
    assert rms(errors(fitted("rings").model)[0]) < 1.0


def test_what_neighbours_add_follows_slow_rods_within_a_turn_of_all_blocks():
    report = fitted("jig")
    hall, n = HallArray(block(), 1), block().count

    def directions(inclination: float, estimator: AngleEstimator) -> np.ndarray:
        a = estimator.angles(hall.field(hinge_angles(np.full((1, n), inclination), np.zeros((1, n))), R_LEVEL)[0], ALL)
        return a.direction

    estimator = AngleEstimator(report.model)
    for inclination in (0.3, 0.32, 0.34):
        directions(inclination, estimator)
    late = directions(0.34, estimator)
    for _ in range(2 * BLOCKS):
        settled = directions(0.34, estimator)
    fresh = AngleEstimator(report.model)
    for _ in range(20):
        known = directions(0.34, fresh)
    np.testing.assert_allclose(settled, known, atol=1e-5)
    assert np.abs(late - known).max() < np.deg2rad(0.02)


def test_neighbours_are_compensated():
    model = fitted("jig").model
    without = rms(errors(replace(model, neighbours=None))[0])
    # 0.1 to 0.25 mT, which is 0.3 to 0.7 deg where neighbours stand all round; here most lack half of them.
    assert np.sqrt(without**2 - rms(errors(model)[0]) ** 2) > 0.1


@pytest.mark.parametrize("source", ["jig", "floor"])
def test_one_outlier_in_twenty_does_no_harm(source: str):
    rng = np.random.default_rng(3)
    clean = jig() if source == "jig" else floor()
    field = clean.field_mT.copy()
    bad = rng.random(field.shape[:-1]) < 0.05
    field[bad] += rng.normal(0.0, 15.0, (int(bad.sum()), 3))
    error, _ = errors(fit_array([replace(clean, field_mT=field)], block()).model)
    assert rms(error) < rms(errors(fitted(source).model)[0]) + 0.05


def test_the_data_driven_model_alone_is_nearly_as_good_in_the_jig():
    report = fit_array([jig()], block(), choose="polynomial")
    assert set(report.chosen) == {"polynomial"}
    assert rms(errors(report.model)[0]) < 0.65
    assert (report.r_squared > 0.994).all()


@pytest.mark.parametrize("folded", [False, True])
def test_folded_data_of_magnets_either_way_up_are_fitted_and_estimated(folded: bool):
    samples = jig()
    report = fit_array([replace(samples, field_mT=fold(samples.field_mT))], block(), folded=folded)
    assert report.model.folded is folded
    assert rms(errors(report.model, folded=True)[0]) <= 0.5


def test_a_reading_near_the_fold_has_no_angles():
    model = fit_array([jig()], block(), folded=True).model
    field = model.rest_mT.copy()
    field[3, 2] = 0.4
    assert np.flatnonzero(~AngleEstimator(model).angles(field, np.ones(12, dtype=bool)).valid).tolist() == [3]


def test_directions_alone_are_enough():
    report = fit_array([jig()], block(), representation="Direction")
    error, _ = errors(report.model)
    assert report.model.representation == "Direction"
    # A direction has less to say than a field, and neighbours are not compensated.
    assert rms(error) < 0.85


def test_dragging_in_one_direction_or_at_one_height_is_refused():
    frames = floor()

    def kept(mask: np.ndarray) -> FloorFrames:
        names = ("height", "direction", "dragged", "field_mT", "valid")
        return replace(frames, **{name: getattr(frames, name)[mask] for name in names})

    with pytest.raises(FitError, match="in 1 direction only"):
        fit_array([kept(np.abs(frames.direction) < 0.1)], block())
    middle = (np.abs(frames.height - 0.125) < 0.003) | (frames.height > 0.15)
    with pytest.raises(FitError, match="at one height only"):
        fit_array([kept(middle)], block())
    with pytest.raises(FitError, match="no drag"):
        fit_array([replace(frames, dragged=np.zeros_like(frames.dragged))], block())


def test_ring_plates_of_one_size_are_refused():
    with pytest.raises(FitError, match="one size only"):
        fit_array([ring_sweep(block(), 1, plates_deg=(30.0,))], block())


def test_a_file_of_the_array_gives_the_same_angles_and_a_moved_array_is_refused():
    report = fitted("floor")
    text = to_text(report, array_id="a", layout="block", rows=3, cols=4, date="2026-01-01")
    calibration = from_text(text, "a.json")
    field = np.random.default_rng(0).normal(0.0, 2.0, (12, 3)) + report.model.rest_mT
    fresh, read = AngleEstimator(report.model), AngleEstimator(calibration.model)
    one, other = (estimator.angles(field, np.ones(12, dtype=bool)).inclination for estimator in (fresh, read))
    np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(fresh.sigma(one), read.sigma(other), atol=1e-12)
    check_fits(calibration, layout="block", rows=3, cols=4, where="a.json", p_base=block().p_base)
    moved = block().p_base + np.array([0.0, 0.01, 0.0])
    with pytest.raises(CalibrationFileError, match="10 mm from where"):
        check_fits(calibration, layout="block", rows=3, cols=4, where="a.json", p_base=moved)


def test_earths_turning_with_the_robot_is_compensated():
    model, n = fitted("jig").model, block().count
    earth = np.array([0.5, 0.0, 0.0])
    half_turn = np.diag([-1.0, -1.0, 1.0])
    rest = model.rest_mT
    assert model.base_to_sensor is not None
    turned = rest + model.base_to_sensor @ (half_turn.T @ earth - earth)
    inclination = AngleEstimator(model, earth).angles(turned, np.ones(n, dtype=bool), half_turn).inclination
    without = AngleEstimator(model, earth).angles(turned, np.ones(n, dtype=bool)).inclination
    assert np.rad2deg(inclination).max() < 0.3
    assert np.rad2deg(without).min() > 1.0
