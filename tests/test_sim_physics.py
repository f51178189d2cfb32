"""The whiskers' physics against formulas, and how they lie on the ground."""

from __future__ import annotations

from itertools import pairwise

import mujoco
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from robominer_slam import layout
from sim_backend import world
from sim_backend.base_motion import LevelGrid, TouchDown
from sim_backend.carriers import carrier_states
from sim_backend.ground import HeightField
from sim_backend.physics import TIME_STEP, PhysicsEngine, hinge_angles, rod_direction
from sim_backend.waypoints import WaypointPath
from sim_backend.whisker_model import WhiskerMechanics
from sim_backend.world import World

LENGTH, MASS, GRAVITY = 0.15, 0.008, 9.81
INERTIA = MASS * LENGTH**2 / 3


def hanging_free(frame_interval=0.04):
    """The array high above flat ground, not moving."""
    deep = World("deep", HeightField((-2.0, -2.0), 1.0, np.full((5, 5), -1.0)), (), {})
    motion = LevelGrid(WaypointPath([[0.0, 0.0, 0.0]]), TouchDown(height=0.0, run_up=0.0))
    return PhysicsEngine(
        deep,
        layout.thesis_grid(),
        motion,
        read_offset=np.zeros(64),
        frame_interval=frame_interval,
        settle_time=0.0,
    )


@pytest.mark.parametrize(("force", "heading"), [(0.1, 0.0), (0.4, 0.0), (0.9, 0.0), (0.3, np.pi / 2), (0.15, 0.7)])
def test_static_deflection_under_a_tip_force_is_analytic(force, heading):
    """k phi + m g l / 2 sin phi = F l cos phi for a horizontal force.

    Large deflections along the hinges' axes only: between them, two hinges are up to 6 % softer than one spring.
    """
    engine = hanging_free()
    body = engine.model.geom_bodyid[mujoco.mj_name2id(engine.model, mujoco.mjtObj.mjOBJ_GEOM, "whisker10")]
    push = force * np.array([np.cos(heading), np.sin(heading), 0.0])
    for _ in range(60):
        reading = engine.read()
        tip = engine.tips()[10]
        engine.data.xfrc_applied[body] = [*push, *np.cross(tip - engine.data.xipos[body], push)]
    expected = brentq(
        lambda phi: 0.1 * phi + MASS * GRAVITY * LENGTH / 2 * np.sin(phi) - force * LENGTH * np.cos(phi), 0, 1.5
    )
    assert reading.inclination[10] == pytest.approx(expected, rel=0.02)
    # The whisker's y points right, base_link's left.
    assert np.angle(np.exp(1j * (reading.azimuth[10] + heading))) == pytest.approx(0.0, abs=0.02)
    assert reading.inclination[11] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_free_whisker_swings_as_a_damped_oscillator(axis):
    mechanics = WhiskerMechanics()
    engine = hanging_free(frame_interval=TIME_STEP)
    engine._qpos[5, 7 + axis] = 0.1
    angle = np.array([engine.read().hinge[5, axis] for _ in range(160)])
    stiffness = mechanics.stiffness + MASS * GRAVITY * LENGTH / 2
    natural = np.sqrt(stiffness / INERTIA)
    zeta = mechanics.damping(LENGTH) / (2 * np.sqrt(INERTIA * stiffness))
    damped = natural * np.sqrt(1 - zeta**2)
    crossings = np.flatnonzero(np.diff(np.sign(angle)))[:3]
    exact = crossings + angle[crossings] / (angle[crossings] - angle[crossings + 1])
    half_period = np.diff(exact).mean() * TIME_STEP
    assert np.pi / half_period == pytest.approx(damped, rel=0.05)
    swings = [np.abs(angle[a:b]).max() for a, b in pairwise(crossings)]
    decrement = 2 * np.log(swings[0] / swings[1])
    assert decrement == pytest.approx(2 * np.pi * zeta / np.sqrt(1 - zeta**2), rel=0.05)


def test_damping_is_that_of_the_thesis_by_the_physical_formula():
    assert WhiskerMechanics().damping(LENGTH) == pytest.approx(0.0023, abs=5e-5)


def test_hinges_and_angles_are_each_others_inverse():
    rng = np.random.default_rng(0)
    inclination, azimuth = rng.uniform(0, 1.4, 100), rng.uniform(-np.pi, np.pi, 100)
    direction = rod_direction(hinge_angles(inclination, azimuth))
    expected = np.stack(
        [np.sin(inclination) * np.cos(azimuth), np.sin(inclination) * np.sin(azimuth), np.cos(inclination)], axis=-1
    )
    np.testing.assert_allclose(direction, expected, atol=1e-12)


def test_mounts_move_as_the_body_that_carries_them():
    """Velocities and accelerations of the mounts against finite differences of their poses, on a curve."""
    motion = LevelGrid(WaypointPath([[0.0, 0.0, 0.3], [0.5, 0.4, 2.0]]))
    grid, h = layout.thesis_grid(), 1e-4
    before, now, after = (carrier_states(motion.at([3.5 + k * h]), grid) for k in (-1, 0, 1))
    moved = (after.pose - before.pose)[0, :, :3] / (2 * h)
    np.testing.assert_allclose(moved, now.velocity[0, :, :3], atol=1e-6)
    changed = (after.velocity - before.velocity)[0, :, :3] / (2 * h)
    np.testing.assert_allclose(changed, now.acceleration[0, :, :3], atol=1e-5)
    turned = Rotation.from_quat(now.pose[0, :, 3:], scalar_first=True)
    np.testing.assert_allclose(turned.as_matrix(), now.R[0], atol=1e-12)
    spin = (turned.inv() * Rotation.from_quat(after.pose[0, :, 3:], scalar_first=True)).as_rotvec() / h
    np.testing.assert_allclose(spin, now.velocity[0, :, 3:], atol=1e-4)


@pytest.fixture(scope="module")
def over_the_brick():
    """Ten seconds of scenario 1 with the brick in it: readings, and tips at the end of each frame."""
    thesis = world.thesis()
    engine = PhysicsEngine(
        thesis,
        layout.thesis_grid(),
        LevelGrid(WaypointPath(thesis.scenario(1))),
        read_offset=np.arange(64) * 600e-6,
    )
    return [(engine.read(), engine.tips()) for _ in range(250)]


def test_whiskers_touch(over_the_brick):
    assert np.mean([reading.contact for reading, _ in over_the_brick]) > 0.95


def test_whiskers_do_not_sink(over_the_brick):
    depth = np.concatenate([reading.depth[~np.isnan(reading.depth)] for reading, _ in over_the_brick])
    assert np.median(depth) < 0.001
    assert np.percentile(depth, 95) < 0.003
    tips = np.concatenate([tips for _, tips in over_the_brick])
    below = world.thesis().height(tips[:, 0], tips[:, 1]) - tips[:, 2]
    assert np.median(below) < 0.001
    assert np.percentile(below, 95) < 0.003


def test_tips_lie_on_the_surface(over_the_brick):
    """Within the rounding of the rod, but where a tip leans on the brick's side or swings."""
    readings, tips = zip(*over_the_brick, strict=True)
    touching = np.concatenate([reading.contact for reading in readings])
    tip = np.concatenate(tips)[touching]
    gap = np.abs(tip[:, 2] - world.thesis().height(tip[:, 0], tip[:, 1]))
    assert np.percentile(gap, 90) < 0.0016


def test_whiskers_trail_behind_the_motion(over_the_brick):
    """In steady forward motion azimuths point backwards."""
    azimuth = np.concatenate([reading.azimuth for reading, _ in over_the_brick if 4.0 < reading.time < 10.0])
    off = np.abs(np.angle(np.exp(1j * (azimuth - np.pi))))
    assert np.median(off) < np.deg2rad(5.0)


def test_whiskers_do_not_chatter(over_the_brick):
    inclination = np.array([reading.inclination for reading, _ in over_the_brick])
    assert np.percentile(np.abs(np.diff(inclination, n=2, axis=0)), 90) < np.deg2rad(0.5)


def test_sensors_are_read_one_after_the_other():
    """A later sensor sees a later angle: read at once or one after the other differs, and only by the delay."""
    thesis = world.thesis()
    at_once, in_turn = (
        PhysicsEngine(
            thesis,
            layout.thesis_grid(),
            LevelGrid(WaypointPath(thesis.scenario(1))),
            read_offset=np.arange(64) * period,
        )
        for period in (0.0, 600e-6)
    )
    first, second = [], []
    for _ in range(80):
        first.append(at_once.read().hinge)
        second.append(in_turn.read().hinge)
    now, following, read = first[-2], first[-1], second[-2]
    share = np.arange(64)[:, None] * 600e-6 / 0.04
    between = now + share * (following - now)
    assert np.abs(now[0] - read[0]).max() == 0.0
    assert np.abs(read - now)[40:].max() > 1e-3
    assert np.median(np.abs(read - between)) < 1e-3


def test_a_frame_that_does_not_fit_its_interval_is_refused():
    thesis = world.thesis()
    with pytest.raises(ValueError, match="frames overlap"):
        PhysicsEngine(
            thesis,
            layout.thesis_grid(),
            LevelGrid(WaypointPath(thesis.scenario(1))),
            read_offset=np.arange(64) * 700e-6,
        )
