"""Calibration: fit, apply, file format, refusals."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calibration.angle_estimator import AngleEstimator
from calibration.file_format import CalibrationFileError, check_fits, from_text, to_text
from calibration.fit import FitError, FitReport, JigSamples, direction_error, fit_jig
from calibration.polynomial import angles_from_tilt, dipole_coordinates, monomials, tilt_from_angles


def dipole_field(inclination: np.ndarray, azimuth: np.ndarray, moment: float = 900.0, gap: float = 4.0) -> np.ndarray:
    """Field (mT) of a dipole that tilts about a pivot above the sensor, from the textbook formula; lengths in mm."""
    axis = np.stack(
        [np.sin(inclination) * np.cos(azimuth), np.sin(inclination) * np.sin(azimuth), np.cos(inclination)], axis=-1
    )
    r = -(np.array([0.0, 0.0, gap + 0.5]) - 0.5 * axis)
    distance = np.linalg.norm(r, axis=-1, keepdims=True)
    unit = r / distance
    return -moment * (3.0 * unit * np.sum(unit * axis, axis=-1, keepdims=True) - axis) / distance**3


def jig_rows(rng: np.random.Generator, whiskers: list[tuple[int, int]], noise: float = 0.1) -> list[list[float]]:
    inclination = np.repeat([0.0, 10, 20, 30, 40, 50, 60, 70], 16)
    azimuth = np.tile(np.arange(-180, 180, 22.5), 8)
    rows = []
    for row, col in whiskers:
        field = dipole_field(np.deg2rad(inclination), np.deg2rad(azimuth)) * rng.normal(1, 0.05)
        field += rng.normal(0, noise, field.shape)
        rows += [[row, col, i, a, *b] for i, a, b in zip(inclination, azimuth, field, strict=True)]
    return rows


@pytest.fixture(scope="module")
def report() -> FitReport:
    rng = np.random.default_rng(3)
    return fit_jig(JigSamples.from_rows(jig_rows(rng, [(0, 0), (0, 1), (1, 1)])), 2, 2)


def test_monomials_equal_powers_multiplied_out():
    u = np.array([0.3, -0.7, 1.1])
    found = sorted(monomials(u, 3).tolist())
    expected = sorted(
        u[0] ** i * u[1] ** j * u[2] ** k for i in range(4) for j in range(4) for k in range(4) if i + j + k <= 3
    )
    assert found == pytest.approx(expected)


def test_held_out_angles_are_right_over_the_range(report: FitReport):
    rng = np.random.default_rng(5)
    rows = np.array(jig_rows(np.random.default_rng(3), [(0, 0)]))
    inclination, azimuth = np.deg2rad(rng.uniform(0, 65, 500)), rng.uniform(-np.pi, np.pi, 500)
    scale = rows[0, 6] / dipole_field(np.zeros(1), np.zeros(1))[0, 2]
    field = dipole_field(inclination, azimuth) * scale
    errors = []
    for i in range(500):
        array = np.zeros((4, 3))
        array[0] = field[i]
        angles = AngleEstimator(report.model).angles(array, np.ones(4, dtype=bool))
        tilt = tilt_from_angles(angles.inclination[:1], angles.azimuth[:1])
        errors.append(direction_error(tilt, tilt_from_angles(inclination[i : i + 1], azimuth[i : i + 1]))[0])
    assert np.rad2deg(np.sqrt(np.mean(np.square(errors)))) < 0.6


def test_angles_and_tilt_are_inverse():
    inclination, azimuth = np.array([0.2, 1.1]), np.array([-2.0, 3.0])
    back = angles_from_tilt(tilt_from_angles(inclination, azimuth))
    np.testing.assert_allclose(back, (inclination, azimuth), atol=1e-12)


def test_a_whisker_without_samples_is_not_valid_and_zeros_are_dead(report: FitReport):
    field = np.broadcast_to(report.model.rest_mT[0], (4, 3)).copy()
    field[1] = 0.0
    angles = AngleEstimator(report.model).angles(field, np.ones(4, dtype=bool))
    assert angles.valid.tolist() == [True, False, False, True]


def test_beyond_the_calibrated_range_nothing_is_said(report: FitReport):
    field = dipole_field(np.full(4, np.deg2rad(88.0)), np.zeros(4))
    estimator = AngleEstimator(report.model)
    angles = estimator.angles(field, np.ones(4, dtype=bool))
    assert not angles.valid[0]
    assert estimator.out_of_range >= 1


def test_rezero_takes_the_present_reading_as_rest(report: FitReport):
    estimator = AngleEstimator(report.model)
    shifted = report.model.rest_mT + np.array([1.0, -0.5, 0.3])
    before = estimator.angles(shifted, np.ones(4, dtype=bool)).inclination[0]
    estimator.rezero(shifted, np.ones(4, dtype=bool))
    after = estimator.angles(shifted, np.ones(4, dtype=bool)).inclination[0]
    assert np.rad2deg(before) > 0.8
    assert np.rad2deg(after) < 0.6


def test_file_round_trip_keeps_every_number(report: FitReport):
    text = to_text(report, array_id="a7", layout="two", rows=2, cols=2, date="2026-01-01")
    calibration = from_text(text, "a7.json")
    np.testing.assert_array_equal(calibration.model.coefficients, report.model.coefficients)
    np.testing.assert_array_equal(calibration.model.fitted, report.model.fitted)
    assert (calibration.array_id, calibration.layout) == ("a7", "two")


def test_an_edited_or_foreign_file_is_refused_with_one_line(report: FitReport):
    text = to_text(report, array_id="a7", layout="two", rows=2, cols=2, date="2026-01-01")
    edited = json.loads(text)
    edited["whiskers"][0]["rest_mT"][0] += 0.1
    for bad, expected in (
        (json.dumps(edited), "hash"),
        ("{}", "not a calibration"),
        ("nonsense", "not JSON"),
        (text.replace('"version": 2', '"version": 9'), "version 9"),
    ):
        with pytest.raises(CalibrationFileError, match=expected) as error:
            from_text(bad, "a7.json")
        assert "\n" not in str(error.value)
    with pytest.raises(CalibrationFileError, match="the robot's layout is 'thesis-grid'"):
        check_fits(from_text(text, "a7.json"), layout="thesis-grid", rows=8, cols=8, where="a7.json")


@pytest.mark.parametrize(
    ("keep", "expected"),
    [
        (lambda r: r[3] < 90, "no samples at azimuths"),
        (lambda r: r[2] < 15, "reaches 10 deg"),
        (lambda r: r[2] > 5, "no sample at rest"),
        (lambda r: r[3] == -180, "8 samples"),
    ],
)
def test_a_sweep_that_does_not_cover_enough_is_refused(keep, expected):
    rows = [r for r in jig_rows(np.random.default_rng(0), [(0, 0)]) if keep(r)]
    with pytest.raises(FitError, match=expected):
        fit_jig(JigSamples.from_rows(rows), 1, 1)


def test_dipole_coordinates_of_an_ideal_dipole_are_its_tilt():
    inclination, azimuth = np.array([0.0, 0.3, 0.9, 1.3]), np.array([0.0, 2.0, -1.0, 3.0])
    field = 20.0 * np.column_stack(
        [-np.sin(inclination) * np.cos(azimuth), -np.sin(inclination) * np.sin(azimuth), 2.0 * np.cos(inclination)]
    )
    for polarity in (1.0, -1.0):
        rest = polarity * np.array([0.0, 0.0, 40.0])
        found = dipole_coordinates(polarity * field, np.broadcast_to(rest, (4, 3)))
        np.testing.assert_allclose(found[:, :2], -tilt_from_angles(inclination, azimuth), atol=1e-9)
