"""The quasi-static engine: geometry, dragging, and agreement with the physics engine on the same path."""

from __future__ import annotations

import time

import numpy as np
import pytest

from robominer_slam import layout as layouts
from sim_backend import world
from sim_backend.base_motion import LevelGrid
from sim_backend.events import WhiskerEvent
from sim_backend.physics import PhysicsEngine, rod_direction
from sim_backend.quasi_static import QuasiStaticEngine
from sim_backend.robot import RobotSettings, build_robot
from sim_backend.touch_surface import SampledHeight
from sim_backend.waypoints import WaypointPath

GRID = layouts.thesis_grid()
AT_ONCE = np.zeros(64)


def engine_on(name, waypoints=None, read_offset=AT_ONCE, layout=GRID):
    scene = world.load(name)
    motion = LevelGrid(WaypointPath(scene.scenario(1) if waypoints is None else waypoints))
    surface = SampledHeight(scene.height, scene.ground.extent)
    return QuasiStaticEngine(surface, layout, motion, read_offset=read_offset), scene


def far_below(x, _y):
    return np.full(np.shape(x), -1.0)


def drive(engine, frames):
    readings, tips = [], []
    for _ in range(frames):
        readings.append(engine.read())
        tips.append(engine.tips())
    return readings, np.array(tips)


def test_sampled_surface_is_the_worlds():
    scene = world.load("thesis")
    surface = SampledHeight(scene.height, scene.ground.extent)
    rng = np.random.default_rng(0)
    p = np.stack([rng.uniform(-1.0, 4.0, 2000), rng.uniform(-1.2, 2.4, 2000), np.zeros(2000)])
    gap, gradient = surface.gap(p)
    error = np.abs(-gap - scene.height(p[0], p[1]))
    # But for the edges of objects, which become ramps.
    assert np.percentile(error, 98) < 1e-4
    h = 1e-6
    for axis in range(2):
        step = np.zeros((3, 1))
        step[axis] = h
        slope = (surface.gap(p + step)[0] - surface.gap(p - step)[0]) / (2 * h)
        assert np.percentile(np.abs(slope - gradient[axis]), 95) < 1e-6


def test_tips_lie_on_flat_ground_and_trail():
    engine, _ = engine_on("flat", [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    readings, tips = drive(engine, 250)
    assert all(reading.contact.all() for reading in readings)
    # The rounded end touches: its centre is a rod's radius above the ground.
    reach = GRID.length[0] - 0.0015
    expected = np.arccos((0.13 - 0.0015) / reach)
    for reading in readings[25:]:
        np.testing.assert_allclose(reading.inclination, expected, atol=2e-3)
    off = np.abs(np.angle(np.exp(1j * (readings[-1].azimuth - np.pi))))
    assert off.max() < np.deg2rad(2.0)
    below = -0.13 - tips[25:, :, 2]
    assert np.abs(below).max() < 0.001


def test_a_tip_follows_its_mount_on_a_tractrix():
    """On flat ground with isotropic pull a rod turned to the side comes round over its own horizontal length."""
    engine, _ = engine_on("flat", [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.5, 0.5, 0.0]])
    readings, _ = drive(engine, round(engine.motion.duration * 25))
    azimuth = np.array([reading.azimuth for reading in readings])
    # Whisker frames have y to the right: driving left, tips trail to the right.
    assert np.abs(azimuth[-1] - np.pi / 2).max() < np.deg2rad(10.0)
    start = engine.motion.path._start[1]
    place = engine.motion.at(np.arange(len(readings)) * 0.04).position[:, 1]
    radius = np.sqrt(0.1485**2 - 0.1285**2)
    turning = (np.arange(len(readings)) * 0.04 > start) & (place < 0.3)
    # Tractrix: tan(beta / 2) falls as exp(-s / r), beta between rod and way; the hinges hold it back a little.
    beta = np.abs(azimuth[turning] - np.pi / 2)
    tractrix = 2 * np.arctan(np.exp(-place[turning] / radius))[:, None]
    assert np.median(np.abs(beta - tractrix)) < np.deg2rad(6.0)


def test_whiskers_out_of_reach_hang_free():
    scene = world.load("flat")
    motion = LevelGrid(WaypointPath(scene.scenario(1)))
    far_down = SampledHeight(far_below, scene.ground.extent)
    engine = QuasiStaticEngine(far_down, GRID, motion, read_offset=AT_ONCE)
    readings, _ = drive(engine, 10)
    assert not any(reading.contact.any() for reading in readings)
    assert max(reading.inclination.max() for reading in readings) < 1e-6
    assert np.isnan(readings[-1].depth).all()


def test_slanted_whiskers_sag_by_their_weight():
    """m g l / 2 sin(tilt) against k plus the weight's own part: the rm3 wall rows, 57 deg from straight down."""
    scene = world.load("flat")
    motion = LevelGrid(WaypointPath(scene.scenario(1)))
    far_down = SampledHeight(far_below, scene.ground.extent)
    rm3 = layouts.rm3()
    engine = QuasiStaticEngine(far_down, rm3, motion, read_offset=np.zeros(80))
    sag = engine.read().inclination[48:]
    weight, tilt = 0.008 * 9.81 * 0.075 / 0.1, np.pi - 2.15
    assert sag == pytest.approx(np.full(32, weight * np.sin(tilt - sag[0])), rel=0.02)


def test_hinges_point_where_the_angles_do():
    engine, _ = engine_on("thesis")
    reading = drive(engine, 80)[0][-1]
    direction = rod_direction(reading.hinge)
    np.testing.assert_allclose(np.cos(reading.inclination), direction[:, 2], atol=1e-9)
    np.testing.assert_allclose(np.tan(reading.azimuth), direction[:, 1] / direction[:, 0], rtol=1e-6)


def test_each_sensor_is_read_at_its_own_time():
    """Later sensors see the tips farther on: read at once and in turn differ by the way driven in between."""
    at_once, _ = engine_on("flat")
    in_turn, _ = engine_on("flat", read_offset=np.arange(64) * 600e-6)
    for _ in range(150):
        at_once.read()
        in_turn.read()
    ahead = (in_turn.tips() - at_once.tips())[:, 0]
    np.testing.assert_allclose(ahead, 0.15 * np.arange(64) * 600e-6, atol=5e-4)


@pytest.mark.parametrize("name", ["thesis", "corridor", "random:1", "random:2", "random:3", "random:4"])
def test_whiskers_do_not_sink(name):
    engine, scene = engine_on(name)
    readings, tips = drive(engine, 600)
    contact = np.array([reading.contact for reading in readings])
    assert contact.mean() > 0.6
    below = scene.height(tips[..., 0], tips[..., 1]) - tips[..., 2]
    assert np.median(below[contact]) < 0.001
    assert np.percentile(below[contact], 95) < 0.003


def test_it_agrees_with_the_physics_on_the_same_path():
    """Scenario 1 up to A: over the brick and on to the slide."""
    engine, scene = engine_on("thesis")
    physics = PhysicsEngine(scene, GRID, LevelGrid(WaypointPath(scene.scenario(1))), read_offset=AT_ONCE)
    readings, tips = drive(engine, 300)
    expected, contact = [], []
    for _ in range(300):
        expected.append(physics.tips())
        contact.append(physics.read().contact)
    difference = np.linalg.norm(tips - np.array(expected), axis=-1)
    assert np.median(difference) < 0.005
    # Once the start is forgotten and before the brick, the same to a millimetre.
    assert np.median(difference[125:200]) < 0.0015
    assert np.mean(np.array([r.contact for r in readings]) == contact) > 0.98


def test_the_same_drive_gives_the_same_readings():
    one, two = engine_on("thesis")[0], engine_on("thesis")[0]
    for _ in range(100):
        assert (one.read().hinge == two.read().hinge).all()


def test_it_is_many_times_faster_than_real_time():
    """A loose bound, for a busy machine; the benchmark has the figures."""
    engine, _ = engine_on("thesis")
    start = time.process_time()
    drive(engine, 500)
    assert 20.0 / (time.process_time() - start) > 60.0


def test_the_robot_runs_on_it():
    robot = build_robot(engine="quasi-static", settings=RobotSettings(max_time=1.0))
    frames = [event for event in robot.events() if isinstance(event, WhiskerEvent)]
    assert len(frames) == 25
    assert frames[-1].truth.contact.mean() > 0.9


def test_a_frame_that_does_not_fit_its_interval_is_refused():
    with pytest.raises(ValueError, match="frames overlap"):
        engine_on("flat", read_offset=np.arange(64) * 700e-6)
