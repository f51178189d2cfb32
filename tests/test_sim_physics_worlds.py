"""The physics engine in every world: nothing sinks, walls and shafts hold, and both engines agree."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robominer_slam import layout as layouts
from sim_backend import world as worlds
from sim_backend.base_motion import LevelGrid, TouchDown
from sim_backend.engines import base_motion_on, build_engine
from sim_backend.ground import HeightField
from sim_backend.ground_contacts import GroundContacts
from sim_backend.physics import TIME_STEP, PhysicsEngine, rod_direction
from sim_backend.robot import RobotSettings, build_robot
from sim_backend.sinking import depth_along_rods
from sim_backend.waypoints import WaypointPath
from sim_backend.whisker_model import THESIS_LITERAL, WhiskerMechanics
from sim_backend.world import World

INTERVAL = 0.04
RADIUS = WhiskerMechanics().radius
WORLDS = ["thesis", "flat", "corridor", "random:1", "random:2", "random:3", "random:4", "flooded", "tunnel", "mine"]


def engine_in(name, engine="physics", joint="default"):
    world = worlds.load(name)
    layout = layouts.BUILT_IN[world.layout]()
    motion = base_motion_on(world, WaypointPath(world.scenario(1)))
    at_once = np.zeros(layout.count)
    return build_engine(engine, world, layout, motion, read_offset=at_once, interval=INTERVAL, joint=joint), world


def depths(engine, world, readings, radius=RADIUS):
    """Depth of every rod in every reading, and where it is deepest, both of shape (frames, n)."""
    found = [
        depth_along_rods(world, engine.layout, engine.motion, np.full(len(r.hinge), r.time), r.hinge, radius)
        for r in readings
    ]
    return np.array([depth for depth, _ in found]), np.array([arm for _, arm in found])


@pytest.mark.parametrize("name", WORLDS)
def test_no_place_of_a_rod_sinks_in(name):
    engine, world = engine_in(name)
    readings = [engine.read() for _ in range(250)]
    contact = np.array([reading.contact for reading in readings])
    assert contact.mean() > 0.5
    depth, _ = depths(engine, world, readings)
    assert np.median(depth[contact]) < 0.001
    assert np.percentile(depth[contact], 95) < 0.003


@pytest.mark.parametrize("engine_name", ["physics", "quasi-static"])
def test_contact_points_lie_on_the_surface_and_on_the_rod(engine_name):
    engine, world = engine_in("tunnel", engine_name)
    readings = [engine.read() for _ in range(100)]
    for reading in readings:
        assert (np.isnan(reading.contact_arm) == ~reading.contact).all()
        assert (np.isnan(reading.contact_point).any(axis=1) == ~reading.contact).all()
    contact = np.array([reading.contact for reading in readings])
    point = np.array([reading.contact_point for reading in readings])[contact]
    gap, gradient = world.walls.gap(point.T)
    assert np.percentile(np.abs(gap) / np.linalg.norm(gradient, axis=0), 95) < 0.001
    arm = np.array([reading.contact_arm for reading in readings])[contact]
    assert arm.max() < 0.151
    assert np.median(arm) == pytest.approx(0.149, abs=0.001)


def test_engines_agree_in_the_tunnel():
    """The same path, floor and walls, by physics and by geometry."""
    physics, _ = engine_in("tunnel")
    geometry, _ = engine_in("tunnel", "quasi-static")
    difference, touching = [], []
    for _ in range(300):
        tips = physics.tips()  # before the reading: where the rods are as it begins
        one, other = physics.read(), geometry.read()
        difference.append(np.linalg.norm(tips - geometry.tips(), axis=1))
        touching.append([one.contact, other.contact])
    assert np.median(difference) < 0.005
    by_rows = np.array(difference).reshape(-1, 80)
    assert np.median(by_rows[:, 48:]) < 0.005  # the wall rows alone
    one, other = np.array(touching).swapaxes(0, 1)
    assert np.mean(one == other) > 0.9


class Corner:
    """Floor z = 0 and wall y = 1, the rock beyond."""

    def parts(self, p):
        floor, wall = np.zeros_like(p), np.zeros_like(p)
        floor[2], wall[1] = 1.0, -1.0
        return (p[2], floor), (1.0 - p[1], wall)

    def gap(self, p):
        (low, up), (side, inward) = self.parts(p)
        return np.minimum(low, side), np.where(side < low, inward, up)


def test_an_end_in_a_corner_has_a_plane_on_each_side():
    """And one whose joint is inside the wall is not held by it."""
    contacts = GroundContacts(Corner(), np.full(2, 0.1485))
    joint = np.array([[0.0, 0.0], [0.9, 1.05], [0.12, 0.12]])
    direction = np.array([0.0, 0.6, -0.8])[:, None].repeat(2, axis=1)
    contacts.place(joint, direction)
    end = (joint + 0.1485 * direction).T
    np.testing.assert_allclose(contacts.position[0], end * [1, 1, 0], atol=1e-12)
    np.testing.assert_allclose(contacts.position[1, 0], [end[0, 0], 1.0, end[0, 2]], atol=1e-12)
    assert contacts.position[1, 1, 1] > 1.9
    for part, normal in enumerate([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]):
        turned = Rotation.from_quat(np.roll(contacts.quaternion[part, 0], -1)).apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(turned, normal, atol=1e-9)


def test_ends_are_in_neither_floor_nor_wall():
    """Each on its own: `gap` would tell of the nearer only."""
    engine, world = engine_in("tunnel")
    readings = [engine.read() for _ in range(150)]
    for reading in readings[::10]:
        end = end_of_rods(engine, reading)
        for gap, gradient in world.walls.parts(end.T):
            depth = RADIUS - gap / np.linalg.norm(gradient, axis=0)
            assert np.percentile(depth, 99) < 0.003


def end_of_rods(engine, reading):
    base, layout = engine.motion.at([reading.time]), engine.layout
    direction = np.einsum("nij,nj->ni", layout.R_base_whisker, rod_direction(reading.hinge))
    in_base = layout.p_base + (layout.length - RADIUS)[:, None] * direction
    return base.position[0] + in_base @ base.R[0].T


def profile(height, cell=0.01):
    """A world whose ground is height(x) at all y, without objects."""
    x = np.arange(-1.5, 2.5, cell)
    return World("profile", HeightField((-1.5, -1.5), cell, np.tile(height(x), (400, 1))), (), {})


def driven_over(world, way, frames, mechanics=None):
    motion = LevelGrid(WaypointPath(way), TouchDown())
    grid = layouts.thesis_grid()
    engine = PhysicsEngine(world, grid, motion, read_offset=np.zeros(64), mechanics=mechanics)
    return engine, [engine.read() for _ in range(frames)]


def test_a_shaft_is_held_by_a_ridge():
    """A ridge whose far side falls faster than the rods lie: their shafts rest on it, and their ends hang behind."""
    world = profile(lambda x: -0.13 - 0.12 * (x < 0.55) + 0.08 * np.exp(-((x - 0.55) ** 2) / (2 * 0.03**2)))
    engine, readings = driven_over(world, [[0.0, 0.0, 0.0], [1.2, 0.0, 0.0]], 220)
    arm = np.array([reading.contact_arm for reading in readings])
    contact = np.array([reading.contact for reading in readings])
    on_shaft = contact & (arm < 0.13)
    assert on_shaft.sum() > 300
    depth, _ = depths(engine, world, readings)
    assert np.median(depth[on_shaft]) < 0.001
    assert np.percentile(depth[on_shaft], 95) < 0.003


def test_hung_free_dragged_and_slipped_off_an_edge():
    """Over a step down of 15 cm: dragged before it, off its edge within a frame, and free behind it."""
    world = profile(lambda x: np.where(x < 0.6, -0.12, -0.27))
    _, readings = driven_over(world, [[0.0, 0.0, 0.0], [1.3, 0.0, 0.0]], 260)
    contact = np.array([reading.contact for reading in readings])
    inclination = np.array([reading.inclination for reading in readings])
    azimuth = np.array([reading.azimuth for reading in readings])
    expected = np.arccos((0.12 - RADIUS) / (0.15 - RADIUS))
    dragged = slice(10, 40)
    assert contact[dragged].all()
    assert np.abs(inclination[dragged] - expected).max() < np.deg2rad(3.0)
    assert np.abs(np.angle(np.exp(1j * (azimuth[dragged] - np.pi)))).max() < np.deg2rad(10.0)
    # Let go, a rod swings through below its mount and then hangs still.
    assert not contact[-1].any()
    assert inclination[-1].max() < np.deg2rad(0.5)
    slipped = np.diff(inclination, axis=0).min(axis=0)
    assert slipped.max() < -np.deg2rad(10.0)  # each of them, within one frame


def test_caught_by_an_edge_and_torn_off():
    """Driven backwards, rods that lean forward against a step up are bent far over before they come free."""
    world = profile(lambda x: np.where(x < -0.35, -0.07, -0.14))
    engine, readings = driven_over(world, [[0.0, 0.0, 0.0], [-0.8, 0.0, 0.0]], 150)
    inclination = np.array([reading.inclination for reading in readings])
    flat = np.arccos((0.14 - RADIUS) / (0.15 - RADIUS))
    assert (inclination.max(axis=0) > flat + np.deg2rad(25.0)).sum() > 10
    depth, _ = depths(engine, world, readings)
    assert np.percentile(depth, 95) < 0.003


def test_the_thesis_literal_joint_creeps_back_with_its_time_constant():
    """Overdamped: c / k = 17.5 ms. The slow one of its two poles is 16.9 ms."""
    deep = World("deep", HeightField((-2.0, -2.0), 1.0, np.full((5, 5), -1.0)), (), {})
    engine = PhysicsEngine(
        deep,
        layouts.thesis_grid(),
        LevelGrid(WaypointPath([[0.0, 0.0, 0.0]]), TouchDown(height=0.0, run_up=0.0)),
        read_offset=np.zeros(64),
        frame_interval=TIME_STEP,
        settle_time=0.0,
        mechanics=THESIS_LITERAL,
    )
    engine._qpos[5, 7] = 0.1
    angle = np.array([engine.read().hinge[5, 0] for _ in range(40)])
    assert (angle > 0.0).all()  # no oscillation
    fitted = -TIME_STEP / np.polyfit(np.arange(10, 30), np.log(angle[10:30]), 1)[0]
    assert fitted == pytest.approx(0.1 / 5.7, rel=0.05)


def test_the_grid_drives_the_commanded_waypoints_with_the_thesis_literal_joint():
    """Within 5 mm and 0.5 deg, although its rods press with newtons: the carriers in the physics, not the command."""
    thesis = worlds.load("thesis")
    path = WaypointPath([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.0, 0.5]])
    grid = layouts.thesis_grid()
    engine = PhysicsEngine(thesis, grid, LevelGrid(path), read_offset=np.zeros(64), mechanics=THESIS_LITERAL)
    for k in range(round(path.duration / INTERVAL)):
        engine.read()
        pose = path.at(np.array([(k + 1) * INTERVAL])).pose[0]
        mounts = engine._qpos[:, :3]
        np.testing.assert_allclose(mounts.mean(axis=0)[:2], pose[:2], atol=0.005)
        row = mounts[7] - mounts[0]
        was = grid.p_base[7] - grid.p_base[0]
        turned = np.arctan2(row[1], row[0]) - np.arctan2(was[1], was[0])
        assert abs(np.angle(np.exp(1j * (turned - pose[2])))) < np.deg2rad(0.5)


@pytest.mark.parametrize("name", ["tunnel", "mine", "mine:3:120"])
def test_the_robot_drives_galleries_with_physics(name):
    robot = build_robot(name, engine="physics", settings=RobotSettings(max_time=0.4))
    frames = [event for event in robot.events() if hasattr(event, "truth")]
    assert len(frames) == 10
    assert frames[-1].truth.contact.mean() > 0.5
