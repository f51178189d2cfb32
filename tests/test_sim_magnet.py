"""Magnets and Hall sensors: fields against the dipole formula, sensitivity, range, and the jig."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.constants import mu_0
from scipy.spatial.transform import Rotation

from robominer_slam import layout
from sim_backend.jig import COLUMNS, jig_sweep, to_csv
from sim_backend.magnet import EARTH_MT, HallArray, MagnetGeometry, Tolerances, rod_rotation
from sim_backend.physics import hinge_angles

NONE = Tolerances(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
GRID = layout.thesis_grid()


def dipole(moment, r):
    """B of a dipole (A m2) at r (m), T; Jackson, equation 5.56."""
    distance = np.linalg.norm(r, axis=-1, keepdims=True)
    unit = r / distance
    along = (unit * moment).sum(axis=-1, keepdims=True)
    return mu_0 / (4 * np.pi) * (3 * unit * along - moment) / distance**3


def held_at(inclination, azimuth):
    return np.broadcast_to(hinge_angles(np.float64(inclination), np.float64(azimuth)), (64, 2))


def test_far_from_a_small_magnet_the_field_is_a_dipoles():
    geometry = MagnetGeometry(diameter=0.001, height=0.001, gap=0.02)
    array = HallArray(GRID, 1, geometry, NONE)
    R = Rotation.from_euler("XY", held_at(0.6, 0.8)[0])
    moment = geometry.polarization / mu_0 * np.pi * 0.0005**2 * 0.001
    r = np.array([0, 0, -geometry.arm - geometry.gap]) - R.apply([0, 0, -geometry.arm])
    expected = 1e3 * dipole(moment * R.apply([0, 0, 1]), r)
    np.testing.assert_allclose(array._own_field(rod_rotation(held_at(0.6, 0.8)))[7], expected, rtol=2e-3)


def test_a_tilt_at_rest_shows_as_02_to_04_degrees_per_step():
    step = 1e-4
    for tolerances, low, high in ((NONE, 0.25, 0.33), (None, 0.18, 0.42)):
        array = HallArray(GRID, 1, tolerances=tolerances)
        for azimuth in (0.0, np.pi / 2):
            change = array.jig_field(held_at(step, azimuth)) - array.jig_field(held_at(-step, azimuth))
            degrees = np.rad2deg(0.098 * 2 * step / np.linalg.norm(change, axis=1))
            assert low < degrees.min()
            assert degrees.max() < high


def test_fields_stay_in_range_and_unfolded():
    array = HallArray(GRID, 1)
    assert (array.jig_field(held_at(0.0, 0.0))[:, 2] > 0).all()
    for azimuth in np.linspace(-np.pi, np.pi, 13):
        for inclination in np.deg2rad([0, 30, 60, 75]):
            assert np.abs(array.jig_field(held_at(inclination, azimuth))).max() < 130.0


def test_neighbours_and_earth_are_small_but_there():
    array = HallArray(GRID, 1, tolerances=NONE)
    field = array.field(np.zeros((64, 2)), np.eye(3))
    own = array._own_field(rod_rotation(np.zeros((64, 2))))
    neighbours = field - own - EARTH_MT * [1, -1, -1]
    assert 0.01 < np.linalg.norm(neighbours, axis=1).max() < 1.0
    # Whisker 0's neighbours at rest, one dipole after the other.
    moment = 1.2 / mu_0 * np.pi * 0.0025**2 * 0.004
    g = MagnetGeometry()
    sensor = GRID.p_base[0] + [0, 0, g.arm + g.gap]
    expected = sum(dipole(np.array([0, 0, -moment]), sensor - p - [0, 0, g.arm]) for p in GRID.p_base[1:])
    np.testing.assert_allclose(neighbours[0], 1e3 * expected * [1, -1, -1], atol=1e-6)


def test_earths_field_turns_with_the_robot():
    array = HallArray(GRID, 1, tolerances=NONE)
    turned = array.field(np.zeros((64, 2)), Rotation.from_euler("z", 180, degrees=True).as_matrix())
    difference = turned - array.field(np.zeros((64, 2)), np.eye(3))
    np.testing.assert_allclose(difference, np.tile(-2 * EARTH_MT * [1, -1, 0], (64, 1)), atol=1e-9)


def test_readings_have_the_sensors_noise_steps_and_limits():
    array = HallArray(GRID, 1)
    rng = np.random.default_rng(0)
    reading = array.sample(np.full((20000, 3), 10.0), rng)
    np.testing.assert_allclose(reading / 0.098, np.round(reading / 0.098), atol=1e-9)
    assert reading.std() == pytest.approx(np.hypot(0.12, 0.098 / np.sqrt(12)), rel=0.03)
    assert array.sample(np.full((10, 3), 500.0), rng).max() <= 130.0
    assert array.sample(np.full((10, 3), -500.0), rng).min() >= -130.0


def test_the_same_seed_is_the_same_array():
    hinge = held_at(0.5, 1.0)
    one, same, other = (HallArray(GRID, seed).jig_field(hinge) for seed in (7, 7, 8))
    assert (one == same).all()
    assert np.abs(one - other).max() > 0.5
    assert one.std(axis=0).min() > 0.5


def test_jig_table_covers_the_array_and_fits_its_fields():
    rows = jig_sweep(GRID, 3, inclinations_deg=(0, 40, 75), azimuths_deg=range(-150, 181, 30))
    assert rows.shape == (64 * 3 * 12, 7)
    array = HallArray(GRID, 3)
    for row in rows[::97]:
        whisker = int(row[0]) * 8 + int(row[1])
        expected = array.jig_field(held_at(*np.deg2rad(row[2:4])))[whisker]
        assert np.abs(row[4:] - expected).max() < 6 * 0.12
    text = to_csv(rows).splitlines()
    assert text[0] == "row,col,inclination_deg,azimuth_deg,bx_mT,by_mT,bz_mT" == ",".join(COLUMNS)
    assert len(text) == len(rows) + 1
    np.testing.assert_allclose([float(value) for value in text[5].split(",")], rows[4], atol=5e-4)
