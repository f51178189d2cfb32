"""The world: its surface against MuJoCo's rays, its ground against finite differences."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_backend import whisker_model, world
from sim_backend.ground import GroundSpectrum, HeightField, random_ground
from sim_backend.solids import Solid


@pytest.fixture(scope="module")
def thesis():
    return world.thesis()


def test_objects_have_the_height_that_rays_find(thesis):
    solids = "".join(whisker_model._solids(thesis)).replace('contype="0" conaffinity="0"', "")
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{solids}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(0)
    hits = 0
    for solid in thesis.solids:
        for x, y in solid.centre[:2] + rng.uniform(-0.25, 0.25, (60, 2)):
            geom = np.zeros(1, np.int32)
            down = mujoco.mj_ray(model, data, np.array([x, y, 1.0]), np.array([0, 0, -1.0]), None, 1, -1, geom)
            expected = 1.0 - down if down >= 0 else -np.inf
            found = max(float(one.height(np.array(x), np.array(y))) for one in thesis.solids)
            assert found == pytest.approx(expected, abs=1e-9)
            hits += down >= 0
    assert hits > 80


@pytest.mark.parametrize(("shape", "size"), [("box", (0.1, 0.2, 0.3)), ("cylinder", (0.1, 0.4)), ("sphere", (0.2,))])
def test_half_height_is_the_highest_point(shape, size):
    solid = Solid("one", shape, size, np.zeros(3), Rotation.from_euler("xyz", [20, 40, 70], degrees=True).as_matrix())
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 401), np.linspace(-0.5, 0.5, 401))
    highest = solid.height(x, y).max()
    assert highest <= solid.half_height() + 1e-12
    assert highest == pytest.approx(solid.half_height(), abs=3e-3)


def test_normals_agree_with_finite_differences(thesis):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1.0, 4.0, 200), rng.uniform(-1.0, 2.0, 200)
    z, normal = thesis.ground.height_and_normal(x, y)
    np.testing.assert_allclose(z, thesis.ground.height(x, y), atol=1e-12)
    h = 1e-6
    slope_x = (thesis.ground.height(x + h, y) - thesis.ground.height(x - h, y)) / (2 * h)
    slope_y = (thesis.ground.height(x, y + h) - thesis.ground.height(x, y - h)) / (2 * h)
    np.testing.assert_allclose(-normal[:, 0] / normal[:, 2], slope_x, atol=1e-6)
    np.testing.assert_allclose(-normal[:, 1] / normal[:, 2], slope_y, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)


def test_ground_is_smooth_across_cells_and_flat_where_its_nodes_are():
    z = np.random.default_rng(2).uniform(0, 0.1, (6, 7))
    ground = HeightField((0.0, 0.0), 0.1, z)
    y = np.full(2001, 0.27)
    x = np.linspace(0.06, 0.54, 2001)
    slope = np.gradient(ground.height(x, y), x)
    assert np.abs(np.diff(slope)).max() < 0.02
    flat = HeightField((0.0, 0.0), 0.1, np.full((4, 4), 0.3))
    np.testing.assert_allclose(flat.height([0.0, 0.13, 9.0], [0.3, 0.21, -9.0]), 0.3)


def test_thesis_ground_has_its_relief_and_lies_within_the_whiskers_reach(thesis):
    low, high = thesis.ground.z.min(), thesis.ground.z.max()
    assert high - low == pytest.approx(0.10)
    passed = world.passed_ground(thesis.ground, list(thesis.scenarios.values()), world.ARRAY_REACH)
    assert thesis.ground.z[passed].min() == pytest.approx(-0.15)
    tops = [solid.centre[2] + solid.half_height() for solid in thesis.solids]
    # 75 degrees is as far as a calibration reaches.
    assert max(tops) < -0.15 * np.cos(np.deg2rad(75.0))


def test_objects_stand_out_as_much_as_they_should(thesis):
    for solid, above in zip(thesis.solids, [0.05, 0.06, 0.05, 0.06, 0.07], strict=True):
        ground = float(thesis.ground.height(*solid.centre[:2]))
        assert solid.centre[2] + solid.half_height() - ground == pytest.approx(above)


def test_the_same_seed_makes_the_same_ground():
    extent = ((0.0, 1.0), (0.0, 1.0))
    one, same, other = (random_ground(GroundSpectrum(seed), extent, 0.05) for seed in (4, 4, 5))
    assert (one.z == same.z).all()
    assert (one.z != other.z).any()


def test_unknown_world_and_scenario_name_the_known_ones(thesis):
    with pytest.raises(world.WorldError, match="expected one of thesis"):
        world.load("moon")
    with pytest.raises(world.WorldError, match="expected one of 1, 2, 3, 4, 5"):
        thesis.scenario(6)
