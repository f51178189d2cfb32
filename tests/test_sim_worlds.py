"""Worlds by name: random, flat, corridor, tunnel, mines."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robominer_slam.layout import rm3
from sim_backend import world
from sim_backend.engines import base_motion_on, build_engine
from sim_backend.events import WhiskerEvent
from sim_backend.galleries import TwoRoughnesses
from sim_backend.robot import RobotSettings, build_robot
from sim_backend.waypoints import WaypointPath

SEEDS = range(8)


def test_the_same_seed_makes_the_same_random_world():
    world.load.cache_clear()
    one = world.load("random:3")
    world.load.cache_clear()
    again, other = world.load("random:3"), world.load("random:4")
    assert (one.ground.z == again.ground.z).all()
    assert [solid.size for solid in one.solids] == [solid.size for solid in again.solids]
    assert one.ground.z.shape != other.ground.z.shape or (one.ground.z != other.ground.z).any()


@pytest.mark.parametrize("seed", SEEDS)
def test_random_worlds_stay_within_the_whiskers_reach(seed):
    scene = world.load(f"random:{seed}")
    passed = world.passed_ground(scene.ground, list(scene.scenarios.values()), world.ARRAY_REACH)
    assert scene.ground.z[passed].min() == pytest.approx(-0.15)
    highest = -0.15 * np.cos(np.deg2rad(75.0))
    assert scene.ground.z[passed].max() < highest
    assert 3 <= len(scene.solids) <= 8
    for solid in scene.solids:
        top = solid.centre[2] + solid.half_height()
        assert float(scene.ground.height(*solid.centre[:2])) < top < highest


def test_random_grounds_range_from_smooth_to_gravel():
    roughness = []
    for seed in SEEDS:
        z, cell = world.load(f"random:{seed}").ground.z, world.load(f"random:{seed}").ground.cell
        roughness.append(np.std(np.diff(z, axis=1)) / cell)
    assert max(roughness) > 3.0 * min(roughness)


def test_flat_is_flat_and_pressed_by_two_centimetres():
    scene = world.load("flat")
    x, y = np.meshgrid(np.linspace(-1, 4, 50), np.linspace(-1, 2, 50))
    np.testing.assert_allclose(scene.height(x, y), -0.13, atol=1e-12)


def test_the_corridor_changes_across_and_never_along():
    scene = world.load("corridor")
    y = np.linspace(-1.0, 2.0, 301)
    profiles = [scene.height(np.full(301, x), y) for x in (-0.5, 0.713, 3.0)]
    assert np.ptp(profiles[0]) > 0.04
    np.testing.assert_allclose(profiles[1], profiles[0], atol=1e-12)
    np.testing.assert_allclose(profiles[2], profiles[0], atol=1e-12)


@pytest.mark.parametrize("name", ["flat", "corridor", "random:0"])
def test_every_world_has_the_five_scenarios(name):
    thesis = world.load("thesis")
    for number in range(1, 6):
        assert (world.load(name).scenario(number) == thesis.scenario(number)).all()


@pytest.mark.parametrize("name", ["moon", "random:", "random:x", "random:-1"])
def test_unknown_names_list_the_known_ones(name):
    with pytest.raises(world.WorldError, match=r"expected one of thesis, flat, corridor.*random:<seed>"):
        world.load(name)


@pytest.fixture(scope="module", params=["tunnel", "mine"])
def gallery(request):
    """A minute or so of scenario 1: world, motion, contacts and tips at each frame."""
    scene = world.load(request.param)
    motion = base_motion_on(scene, WaypointPath(scene.scenario(1)))
    engine = build_engine("quasi-static", scene, rm3(), motion, read_offset=np.zeros(80), interval=0.04)
    contact, tips = [], []
    for _ in range(1200):
        contact.append(engine.read().contact)
        tips.append(engine.tips())
    return scene, motion, np.array(contact), np.array(tips)


def test_floor_and_wall_whiskers_touch_in_galleries(gallery):
    _, _, contact, _ = gallery
    by_row = contact.reshape(-1, 10, 8).mean(axis=(0, 2))
    assert by_row[:6].min() > 0.9
    assert by_row[6:8].min() > 0.4


def test_tips_lie_on_floor_and_walls(gallery):
    scene, _, contact, tips = gallery
    gap, gradient = scene.walls.gap(tips[contact].T)
    depth = -gap / np.linalg.norm(gradient, axis=0)
    assert np.median(depth) < 0.001
    assert np.percentile(depth, 95) < 0.003
    assert np.percentile(-depth, 95) < 0.0025


def test_the_gradient_of_a_gallery_is_that_of_its_gap():
    walls = world.load("mine").walls
    rng = np.random.default_rng(0)
    p = np.array([[3.0], [0.0], [0.4]]) + rng.uniform(-0.6, 0.6, (3, 2000))
    value, gradient = walls.gap(p)
    # Differences over micrometres need double precision.
    exact = copy.copy(walls)
    object.__setattr__(exact, "_rough", TwoRoughnesses.of(walls.floor, walls.wall, np.float64))
    np.testing.assert_allclose(value, exact.gap(p)[0], atol=1e-8)
    h = 1e-6
    for axis in range(3):
        step = np.zeros((3, 1))
        step[axis] = h
        slope = (exact.gap(p + step)[0] - exact.gap(p - step)[0]) / (2 * h)
        assert np.percentile(np.abs(slope - gradient[axis]), 97) < 1e-5


def test_the_body_follows_the_floor(gallery):
    """Height, pitch and roll change with the floor; its velocities are the differences of its poses."""
    scene, motion, _, _ = gallery
    time = np.linspace(0.0, 48.0, 200)
    base = motion.at(time)
    np.testing.assert_allclose(base.position[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(base.R[0], np.eye(3), atol=1e-12)
    assert np.ptp(base.position[:, 2]) > 0.005
    assert np.rad2deg(np.arccos(base.R[:, 2, 2])).max() > 1.0
    np.testing.assert_allclose(base.R @ base.R.swapaxes(1, 2), np.broadcast_to(np.eye(3), (200, 3, 3)), atol=1e-12)
    floor = scene.height(base.position[:, 0], base.position[:, 1])
    assert np.abs(base.position[:, 2] - floor + 0.135).max() < 0.03
    h = 1e-3
    before, after = motion.at(time - h), motion.at(time + h)
    np.testing.assert_allclose((after.position - before.position) / (2 * h), base.velocity, atol=2e-3)
    spin = Rotation.from_matrix(after.R @ before.R.swapaxes(1, 2)).as_rotvec() / (2 * h)
    np.testing.assert_allclose(spin, base.omega, atol=1e-2)


def test_the_mine_has_loops_and_three_hundred_metres():
    walls = world.load("mine").walls
    assert walls.length >= 300.0
    assert len(walls.edges) - len(walls.nodes) + 1 >= 5  # independent loops of a connected mine
    driven = world.load("mine").scenario(2)[:, :2]
    near = np.linalg.norm(driven[:, None] - walls.nodes, axis=-1).min(axis=0)
    assert near.max() < 1e-9  # scenario 2 comes to every junction
    np.testing.assert_allclose(driven[-1], driven[0])


def test_larger_mines_on_request():
    assert world.load("mine:3:1200").walls.length >= 1200.0
    with pytest.raises(world.WorldError, match="expected one of"):
        world.load("mine:3:much")


def test_the_robot_drives_the_mine():
    robot = build_robot("mine", engine="quasi-static", settings=RobotSettings(max_time=0.4))
    assert robot.layout.name == "rm3"
    assert sum(isinstance(event, WhiskerEvent) for event in robot.events()) == 10
