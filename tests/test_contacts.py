"""Layouts and contact points against scipy's rotations."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.angle_estimator import WhiskerAngles
from robominer_slam import layout as layouts
from robominer_slam.contacts import ContactModel, Contacts, at_frame_start
from robominer_slam.layout import LayoutError, from_json, rm3, thesis_grid, to_json


def leaning(phi: np.ndarray, a: np.ndarray) -> WhiskerAngles:
    direction = np.stack([np.sin(phi) * np.cos(a), np.sin(phi) * np.sin(a), np.cos(phi)])
    return WhiskerAngles(phi, a, direction, np.ones(len(phi), dtype=bool))


def test_thesis_grid_is_as_the_interface_says():
    grid = thesis_grid()
    p = grid.p_base.reshape(8, 8, 3)
    assert p[0, 0, 0] == p[..., 0].max()
    assert p[0, 0, 1] == p[..., 1].max()
    np.testing.assert_allclose(p[0, :, 0] - p[1, :, 0], 0.039)
    np.testing.assert_allclose(p[0, :-1, 1] - p[0, 1:, 1], 0.064)
    np.testing.assert_allclose(p[1, :, 1] - p[0, :, 1], -0.032)
    np.testing.assert_allclose(p.reshape(-1, 3).mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(grid.R_base_whisker[5] @ [0, 0, 1], [0, 0, -1])
    np.testing.assert_allclose(grid.R_base_whisker[5] @ [0, 1, 0], [0, -1, 0])


def test_rm3_points_down_and_outward():
    array = rm3()
    z = (array.R_base_whisker @ np.array([0, 0, 1.0])).reshape(10, 8, 3)
    tilt = np.pi - 2.15
    np.testing.assert_allclose(z[:6], np.broadcast_to([0, 0, -1.0], (6, 8, 3)), atol=1e-12)
    for row, outward in ((6, [0, -1, 0]), (7, [0, 1, 0]), (8, [-1, 0, 0]), (9, [1, 0, 0])):
        expected = np.cos(tilt) * np.array([0, 0, -1.0]) + np.sin(tilt) * np.array(outward, dtype=float)
        np.testing.assert_allclose(z[row], np.broadcast_to(expected, (8, 3)), atol=1e-12)
    assert array.p_base[0, 0] == pytest.approx(-0.0345 - 3 * 0.075)
    assert array.p_base[6 * 8, 1] == -0.35
    assert array.p_base[9 * 8, 1] < 0 < array.p_base[9 * 8 + 7, 1]


def test_tips_equal_rotating_the_rod_by_scipy():
    array = rm3()
    rng = np.random.default_rng(0)
    phi, a = rng.uniform(0, 1.2, array.count), rng.uniform(-np.pi, np.pi, array.count)
    rod = Rotation.from_euler("ZY", np.column_stack([a, phi])).apply([0, 0, 0.15])
    expected = array.p_base + Rotation.from_matrix(array.R_base_whisker).apply(rod)
    found = ContactModel(array, 0.0, 1.3).contacts(leaning(phi, a), np.ones(array.count, dtype=bool))
    np.testing.assert_allclose(found.points, expected, atol=1e-12)
    np.testing.assert_allclose(found.rod.T, expected - array.p_base, atol=1e-12)


def test_free_whiskers_holes_and_invalid_readings_give_no_contact():
    grid = thesis_grid()
    present = grid.present.copy()
    present[3] = False
    grid = layouts.WhiskerLayout("g", 8, 8, grid.p_base, grid.R_base_whisker, grid.length, present)
    phi = np.full(64, 0.5)
    phi[0], phi[1] = 0.01, 1.5
    valid = np.ones(64, dtype=bool)
    valid[2] = False
    contacts = ContactModel(grid, 0.07, 1.22).contacts(leaning(phi, np.zeros(64)), valid)
    assert contacts.index.tolist() == list(range(4, 64))
    assert contacts.points.shape == (60, 3)


def test_layout_file_round_trip():
    back = from_json(to_json(rm3()), "rm3.json")
    np.testing.assert_array_equal(back.p_base, rm3().p_base)
    np.testing.assert_array_equal(back.R_base_whisker, rm3().R_base_whisker)


def test_contacts_of_a_frame_are_brought_to_the_time_of_its_first_sensor():
    """Points that stand in the world, read one after the other from a body that drives and turns."""
    rng = np.random.default_rng(0)
    velocity, period_ns = np.array([0.15, -0.05, 0.4]), 600_000
    index = np.array([0, 17, 40, 63])
    world = rng.uniform(-0.25, 0.25, (4, 3))
    # Pose of base_link at each sensor's reading, in that at the first one's, by small steps.
    read = []
    for k, point in zip(index, world, strict=True):
        t, steps = k * period_ns * 1e-9, 2000
        x = y = yaw = 0.0
        for _ in range(steps):
            dt = t / steps
            x += dt * (np.cos(yaw) * velocity[0] - np.sin(yaw) * velocity[1])
            y += dt * (np.sin(yaw) * velocity[0] + np.cos(yaw) * velocity[1])
            yaw += dt * velocity[2]
        c, s = np.cos(yaw), np.sin(yaw)
        dx, dy = point[0] - x, point[1] - y
        read.append([c * dx + s * dy, c * dy - s * dx, point[2]])
    contacts = Contacts(np.array(read), index, np.zeros(4), np.zeros(4), np.zeros((3, 4)))
    found = at_frame_start(contacts, velocity, period_ns)
    np.testing.assert_allclose(found.points, world, atol=5e-5)
    assert np.abs(contacts.points - world).max() > 3e-3
    assert at_frame_start(contacts, velocity, 0) is contacts


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda d: d.pop("rows"), "lacks the field 'rows'"),
        (lambda d: d["whiskers"].append(dict(d["whiskers"][0])), "named twice"),
        (lambda d: d["whiskers"][0].update(row=70), "outside"),
        (lambda d: d["whiskers"][0].update(rotation=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "not a rotation"),
        (lambda d: d["whiskers"][0].update(length_m=0), "above 0 m"),
        (lambda d: d["whiskers"][0].update(length_m="long"), "not a layout file"),
    ],
)
def test_bad_layouts_are_refused_with_one_line(change, expected):
    data = json.loads(to_json(thesis_grid()))
    change(data)
    with pytest.raises(LayoutError, match=expected) as error:
        from_json(json.dumps(data), "my.json")
    assert "\n" not in str(error.value)
