"""Flooded worlds: flow bends and damps free rods, mud lets tips through to the firm ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.measurement import HallFrame
from drivers.recording_reader import Recording
from robominer_slam import layout as layouts
from sim_backend import world
from sim_backend.base_motion import LevelGrid
from sim_backend.engines import ENGINES, base_motion_on, build_engine
from sim_backend.ground import HeightField
from sim_backend.physics import TIME_STEP, PhysicsEngine
from sim_backend.robot import RobotSettings
from sim_backend.rod_drag import RodDrag
from sim_backend.scene import World
from sim_backend.simulate import SimulationSettings, record_drive
from sim_backend.water import Current, Mud, Water
from sim_backend.waypoints import WaypointPath

GRID = layouts.thesis_grid()
AT_ONCE = np.zeros(64)
STEADY = Current(speed=0.5, direction=0.4, gusts=0.0, eddies=0.0)
STILL = Current(speed=0.0, gusts=0.0, eddies=0.0)


def deep(water, waypoints=((0.0, 0.0, 0.0),)):
    """A world whose ground no whisker reaches."""
    ground = HeightField((-2.0, -2.0), 0.5, np.full((12, 12), -1.0))
    return World("deep", ground, (), {1: np.array(waypoints)}, water=water)


def engine_in(name, scene, **changes):
    motion = base_motion_on(scene, WaypointPath(scene.scenario(1)))
    return build_engine(name, scene, GRID, motion, read_offset=AT_ONCE, interval=0.04, **changes)


def deflection(speed):
    """Angle of a rod in a level flow across it, rad: drag's moment against spring and weight in water, by hand."""
    density, viscosity, diameter, length = 1100.0, 0.005, 0.003, 0.15
    drag_coefficient = 1.0 + 10.0 * (density * speed * diameter / viscosity) ** (-2.0 / 3.0)
    moment = 0.5 * density * drag_coefficient * diameter * speed**2 * length**2 / 2.0
    weight = (0.008 - density * np.pi * 0.0015**2 * length) * 9.81 * length / 2.0
    angle = 0.0
    for _ in range(20):  # the flow meets the inclined rod at cos(angle); the lever of the weight is sin(angle)
        angle = (moment * np.cos(angle) ** 2 - weight * np.sin(angle)) / 0.1
    return angle


@pytest.mark.parametrize("name", ENGINES)
def test_a_free_rod_in_steady_flow_bends_by_the_analytic_value(name):
    reading = engine_in(name, deep(Water(STEADY))).read()
    expected = deflection(0.5)
    assert np.deg2rad(3.0) < expected < np.deg2rad(4.0)
    np.testing.assert_allclose(reading.inclination, expected, rtol=0.05)
    # Whisker frames have y to the right: the rods point where the water flows to.
    np.testing.assert_allclose(reading.azimuth, -0.4, atol=0.02)
    assert not reading.contact.any()


@pytest.mark.parametrize("name", ENGINES)
def test_driving_through_still_water_bends_rods_back(name):
    scene = deep(Water(STILL), [[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]])
    engine = engine_in(name, scene)
    reading = [engine.read() for _ in range(180)][-1]  # 7 s: at full speed
    np.testing.assert_allclose(reading.inclination, deflection(0.15), rtol=0.05)
    np.testing.assert_allclose(np.abs(reading.azimuth), np.pi, atol=0.02)


def swing_of(water):
    """How far rods that are let go at 0.3 rad overshoot, rad."""
    scene = deep(water)
    motion = LevelGrid(WaypointPath(scene.scenario(1)))
    engine = PhysicsEngine(scene, GRID, motion, read_offset=AT_ONCE, frame_interval=TIME_STEP, settle_time=0.0)
    engine._qpos[:, 8] = 0.3
    angle = np.array([engine.read().hinge[:, 1] for _ in range(200)])
    return -angle.min()


def test_water_damps_free_rods():
    in_air, in_water = swing_of(None), swing_of(Water(STILL))
    # Damping ratio 0.47: exp(-pi 0.47 / sqrt(1 - 0.47^2)) of what it was let go at.
    assert in_air == pytest.approx(0.3 * 0.188, rel=0.15)
    assert in_water < 0.6 * in_air


def test_the_water_that_moves_along_adds_to_a_rods_inertia():
    dry, wet = (
        PhysicsEngine(
            deep(water), GRID, LevelGrid(WaypointPath([[0, 0, 0]])), read_offset=AT_ONCE, settle_time=0.0
        ).model.dof_armature.reshape(64, 8)
        for water in (None, Water(STILL))
    )
    displaced = 1100.0 * np.pi * 0.0015**2 * 0.15
    np.testing.assert_allclose((wet - dry)[:, 6:], displaced * 0.15**2 / 3.0)
    np.testing.assert_allclose((wet - dry)[:, :6], 0.0)


def test_mud_holds_the_part_of_the_rod_that_is_in_it():
    """2 cm of mud around the end of a rod dragged at 0.15 m/s: N_p (yield stress D + viscosity v) per length."""
    mud = Mud(top=-0.13)
    still = RodDrag(Water(STILL), GRID.length, 0.0015)
    muddy = RodDrag(Water(STILL, mud), GRID.length, 0.0015)
    n = GRID.count
    down, velocity = np.tile([0.0, 0.0, -1.0], (n, 1)), np.tile([0.15, 0.0, 0.0], (n, 1))
    pulls = [
        drag.load(np.zeros(n), GRID.p_base, velocity, np.zeros((n, 3)), down).pull[:, 0] for drag in (still, muddy)
    ]
    speed, length = 0.15, 0.02
    in_mud = 10.5 * (20.0 * 0.003 * speed / (speed + 0.01) + 0.1 * speed) * length * 0.14
    in_water = 0.5 * 1100.0 * 0.003 * (1.0 + 10.0 * 99.0 ** (-2.0 / 3.0)) * speed**2
    expected = -in_mud - in_water * 0.13**2 / 2.0
    np.testing.assert_allclose(pulls[1], expected, rtol=0.05)
    assert (pulls[1] < 1.5 * pulls[0]).all()


def test_water_buoys_rods_up_and_does_not_flow_in_mud():
    n = GRID.count
    still, level = np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0], (n, 1))
    buoyancy = 1100.0 * np.pi * 0.0015**2 * 0.15 * 9.81 * 0.075
    in_water = RodDrag(Water(STILL), GRID.length, 0.0015).load(np.zeros(n), GRID.p_base, still, still, level)
    np.testing.assert_allclose(in_water.pull, np.tile([0.0, 0.0, buoyancy], (n, 1)), atol=1e-12)
    buried = RodDrag(Water(STEADY, Mud(top=1.0)), GRID.length, 0.0015).load(
        np.zeros(n), GRID.p_base, still, still, level
    )
    np.testing.assert_allclose(buried.pull, in_water.pull, atol=1e-12)


def test_eddies_neither_make_nor_lose_water_and_drift_with_the_current():
    current = Current(3, gusts=0.0)
    rng = np.random.default_rng(0)
    t, x, y = rng.uniform(0.0, 50.0, 3000), rng.uniform(0.0, 20.0, 3000), rng.uniform(0.0, 20.0, 3000)
    h = 1e-4
    change = (current.at(t, x + h, y)[:, 0] - current.at(t, x - h, y)[:, 0]) / (2 * h)
    change += (current.at(t, x, y + h)[:, 1] - current.at(t, x, y - h)[:, 1]) / (2 * h)
    assert np.abs(change).max() < 1e-6
    mean = 0.5 * np.array([np.cos(current.direction), np.sin(current.direction), 0.0])
    eddies = current.at(t, x, y) - mean
    assert np.sqrt(np.square(eddies).sum(axis=1).mean()) == pytest.approx(0.1, rel=0.05)
    later = current.at(t + 2.0, x + 2.0 * mean[0], y + 2.0 * mean[1]) - mean
    np.testing.assert_allclose(later, eddies, atol=1e-9)


def test_gusts_stay_within_their_share():
    time = np.linspace(0.0, 300.0, 3000)
    speed = np.linalg.norm(Current(eddies=0.0).at(time, np.zeros(3000), np.zeros(3000)), axis=1)
    assert 0.4 <= speed.min() < 0.45
    assert 0.55 < speed.max() <= 0.6


@pytest.fixture(scope="module")
def drives():
    """The first 13 s of scenario 1 with each engine: contact, inclination in deg, tips; by engine."""
    scene = world.load("flooded")
    found = {}
    for name in ENGINES:
        engine = engine_in(name, scene)
        readings, tips = [], []
        for _ in range(325):
            if name == "physics":  # its tips are those at the beginning of the next frame
                tips.append(engine.tips())
            readings.append(engine.read())
            if name != "physics":
                tips.append(engine.tips())
        contact = np.array([reading.contact for reading in readings])
        inclination = np.rad2deg([reading.inclination for reading in readings])
        found[name] = contact, inclination, np.array(tips)
    return found


def test_engines_agree_on_where_touching_tips_lie(drives):
    (one, _, tips), (other, _, other_tips) = drives["physics"], drives["quasi-static"]
    both = one & other
    assert both.mean() > 0.7
    assert np.median(np.linalg.norm(tips - other_tips, axis=-1)[both]) < 0.005
    assert (one == other).mean() > 0.95


@pytest.mark.parametrize("name", ENGINES)
def test_flow_makes_false_contacts(drives, name):
    """A good share of free whiskers is inclined as if it touched, and the truth says that it does not."""
    contact, inclination, _ = drives[name]
    assert (inclination[~contact] > 3.0).mean() > 0.3


@pytest.mark.parametrize("name", ENGINES)
def test_tips_go_through_mud_and_rest_on_firm_ground(drives, name):
    scene = world.load("flooded")
    contact, _, tips = drives[name]
    touching = tips[contact]
    firm = scene.height(touching[:, 0], touching[:, 1])
    below = firm - touching[:, 2]
    assert np.median(below) <= 0.001
    assert np.percentile(below, 95) <= 0.003
    in_mud = firm < scene.water.mud.top - 0.002
    assert in_mud.sum() > 50
    assert (touching[in_mud, 2] < scene.water.mud.top).mean() > 0.9


def test_a_good_share_of_whiskers_hangs_free_in_scenario_1():
    for name in ("flooded", "flooded:1"):
        scene = world.load(name)
        engine = engine_in("quasi-static", scene)
        frames = round(25 * WaypointPath(scene.scenario(1)).duration)
        free = np.array([~engine.read().contact for _ in range(frames)])
        assert 0.15 < free.mean() < 0.40


@pytest.mark.parametrize("name", ENGINES)
def test_the_same_seed_gives_the_same_readings_and_another_seed_other_water(name):
    scene = world.load("flooded")
    other = replace(scene, water=replace(scene.water, current=Current(1)))
    first, again, changed = (engine_in(name, each) for each in (scene, scene, other))
    for _ in range(20):
        one, two, three = first.read(), again.read(), changed.read()
        assert (one.hinge == two.hinge).all()
        assert (one.hinge != three.hinge).any()


def test_a_flooded_drive_can_be_recorded(tmp_path):
    settings = SimulationSettings(tmp_path, world="flooded", engine="quasi-static", robot=RobotSettings(max_time=2.0))
    record_drive(settings, tmp_path / "drive.mcap")
    recording = Recording(tmp_path / "drive.mcap")
    assert recording.metadata["world"] == "flooded"
    assert sum(isinstance(message, HallFrame) for _, message in recording) == 50
