"""Touches of walls: residuals and their slopes, and what walls tell of the pose."""

import numpy as np
import pytest

from robominer_slam.configuration.robust_slam_section import ScanMatchingSection
from robominer_slam.slam.scan_odometry import ScanOdometry
from robominer_slam.slam.surface import Surface, SurfaceModel
from robominer_slam.slam.surface_registration import fit, height_left_free, placed
from robominer_slam.slam.wall_odometry import way_along
from robominer_slam.slam.wall_registration import WallTouches, wall_terms
from robominer_slam.slam.wall_surface import WallSurface

MODEL = SurfaceModel(touch_sigma=0.0012, curvature=3.0, slope_sigma=0.3, reach=0.045)
HEIGHT = 0.23
TOUCH_NOISE = 0.0004
NO_PRIOR = np.zeros((4, 4))
#: Whiskers of a robot's two sides.
ALONG = 0.075 * np.arange(-3, 5)


def smooth(x, z):
    return 0.44 + 0.0 * x


def rough(x, z):
    return 0.44 + 0.012 * np.sin(2.0 * np.pi * x / 0.4) + 0.006 * np.sin(2.0 * np.pi * (x + z) / 0.23)


def walls(depth, rng, *, lines: int = 3) -> np.ndarray:
    """Touches along lines of two walls, the left one at y = depth, the right one its mirror image."""
    x = np.tile(np.arange(-1.5, 1.5, 0.005), 2 * lines)
    z = np.repeat(HEIGHT + 0.004 * np.arange(2 * lines), len(x) // (2 * lines))
    side = np.where(np.arange(len(x)) % 2, 1.0, -1.0)
    y = side * (depth(x, z) + rng.normal(0.0, TOUCH_NOISE, len(x)))
    return np.column_stack([x, y, z])


def sides(depth, pose) -> np.ndarray:
    """Touches of both sides' whiskers, in the frame of a robot at a pose, over the last 0.3 m of its way."""
    parts = []
    for back in np.arange(0.0, 0.3, 0.02):
        for side in (-1.0, 1.0):
            x = ALONG - back
            z = np.full(len(x), HEIGHT + 0.005)
            parts.append(np.column_stack([x, side * depth(x, z), z]))
    on_walls = np.concatenate(parts)
    x, y, yaw, z = pose
    back_to_robot = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return np.column_stack([(on_walls[:, :2] - [x, y]) @ back_to_robot.T, on_walls[:, 2] - z])


def flat_floor(rng, count: int, half: float) -> np.ndarray:
    return np.column_stack([rng.uniform(-half, half, (count, 2)), rng.normal(0.0, TOUCH_NOISE, count)])


def matched(depth, truth, seed: int = 0):
    """The walls fitted from a guess at the origin, with a flat floor that tells the height alone."""
    rng = np.random.default_rng(seed)
    touches = WallTouches(WallSurface(walls(depth, rng), MODEL), sides(depth, truth))
    floor = flat_floor(rng, 48, 0.2) - [0.0, 0.0, truth[3]]
    return fit(Surface(flat_floor(rng, 4000, 0.6), MODEL), floor, np.zeros(4), NO_PRIOR, 6, touches)


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobian_is_the_residuals_derivative(seed):
    """On a wall turned anyhow, that leans and waves; a wave is shorter than what tells the wall's direction."""
    rng = np.random.default_rng(seed)
    turn, lean = rng.uniform(-np.pi, np.pi), rng.uniform(-0.1, 0.1)
    c, s = np.cos(turn), np.sin(turn)

    def on_wall(along, up):
        depth = 0.006 * np.sin(2.0 * np.pi * along / 0.2) + lean * up
        return np.column_stack([c * along - s * depth, s * along + c * depth, up])

    surface = WallSurface(on_wall(rng.uniform(-0.6, 0.6, 12000), rng.uniform(-0.02, 0.02, 12000)), MODEL)
    pose = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(-1.0, 1.0), 0.0])
    q = on_wall(rng.uniform(-0.3, 0.3, 30), np.zeros(30)) + rng.normal(0.0, 0.002, (30, 3))
    c_pose, s_pose = np.cos(pose[2]), np.sin(pose[2])
    points = (q - [pose[0], pose[1], 0.0]) @ np.array([[c_pose, -s_pose, 0.0], [s_pose, c_pose, 0.0], [0.0, 0.0, 1.0]])
    terms = wall_terms(surface, q[None], pose[None])
    for k, step in enumerate((0.01, 0.01, 0.02, 0.01)):
        moved = [pose + sign * step * np.eye(4)[k] for sign in (1.0, -1.0)]
        ahead, behind = (wall_terms(surface, placed(points, p)[None], p[None]).residual[0] for p in moved)
        assert terms.jacobian[0, k] == pytest.approx((ahead - behind) / (2.0 * step), abs=0.025)


def test_smooth_straight_walls_tell_the_place_across_and_the_heading_but_nothing_along():
    truth = np.array([0.0, 0.012, 0.02, 0.0])
    found = matched(smooth, truth)
    assert found.pose[[1, 2]] == pytest.approx(truth[[1, 2]], abs=0.0008)
    information = height_left_free(found.information)
    apparent = height_left_free(found.curvature)
    assert information[0, 0] < 1e-3 * information[1, 1]
    assert information[1, 1] > 0.5 * apparent[1, 1]
    assert information[2, 2] > 0.5 * apparent[2, 2]


def test_rough_walls_tell_the_place_along_too():
    truth = np.array([0.012, -0.008, 0.01, 0.0])
    found = matched(rough, truth)
    assert found.pose[:3] == pytest.approx(truth[:3], abs=0.0015)
    assert height_left_free(found.information)[0, 0] > 0.2 * height_left_free(found.curvature)[0, 0]


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_the_way_along_is_told_by_roughness_and_by_nothing_else(turn):
    off = 0.006
    rng = np.random.default_rng(3)
    touched = walls(rough, rng)
    c, s = np.cos(turn), np.sin(turn)
    turned = np.column_stack(
        [c * touched[:, 0] - s * touched[:, 1], s * touched[:, 0] + c * touched[:, 1], touched[:, 2]]
    )
    # The robot is 2 mm beside its prediction, and turned by 2 mrad: neither is told.
    points = sides(rough, np.array([off, 0.002, 0.002, 0.0]))
    found = way_along(WallSurface(turned, MODEL), points, np.array([0.0, 0.0, turn, 0.0]))
    assert found is not None
    assert abs(found.direction @ [c, s]) == pytest.approx(1.0, abs=1e-3)
    assert found.offset * (found.direction @ [c, s]) == pytest.approx(off, abs=0.001)
    assert found.known > 0.25 * found.apparent
    plain = way_along(WallSurface(walls(smooth, rng), MODEL), sides(smooth, np.zeros(4)), np.zeros(4))
    assert plain is None or plain.known < 0.25 * plain.apparent


def test_scans_are_matched_with_walls_where_there_are_any():
    scans = ScanOdometry(ScanMatchingSection(), MODEL, 0.7)
    rng = np.random.default_rng(4)
    for x in np.arange(0.0, 0.8, 0.02):
        pose = np.array([x, 0.0, 0.0, 0.0])
        seen = rough(x + ALONG, HEIGHT)
        noise = rng.normal(0.0, TOUCH_NOISE, (2, len(ALONG)))
        touches = [np.column_stack([ALONG, side * (seen + noise[k]), 0.0 * ALONG]) for k, side in enumerate((-1, 1))]
        scans.moved(*pose[:3])
        correction = scans.match_walls(pose - [0.004, 0.0, 0.0, 0.0], np.concatenate(touches))
        scans.add(pose, np.zeros((0, 3)), np.concatenate(touches))
    assert correction is not None
    assert correction.offset == pytest.approx([0.004, 0.0, 0.0], abs=0.002)
    assert correction.information[0, 0] > 1e3
    assert correction.information[2] == pytest.approx(np.zeros(3))


def test_touches_without_a_direction_are_no_wall():
    rng = np.random.default_rng(1)
    heap = WallSurface(rng.uniform(-0.1, 0.1, (400, 3)), MODEL)
    assert not heap.at(rng.uniform(-0.05, 0.05, (20, 3))).known.any()


def test_no_touches_know_no_wall():
    assert not WallSurface(np.zeros((0, 3)), MODEL).at(np.zeros((3, 3))).known.any()
