"""The pipeline as a whole on made measurements: states, wrong frames, IMU mounting."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.fit import JigSamples, fit_jig
from drivers.measurement import HallFrame, ImuSample, ScrewAngles
from robominer_slam.assembly import build_pipeline
from robominer_slam.configuration.file import parse
from robominer_slam.frame_result import FrameResult
from robominer_slam.layout import thesis_grid
from robominer_slam.pipeline import Pipeline
from tests.test_calibration import dipole_field, jig_rows

MS = 1_000_000


@pytest.fixture(scope="module")
def model():
    rows = jig_rows(np.random.default_rng(0), [(r, c) for r in range(8) for c in range(8)], noise=0.0)
    return fit_jig(JigSamples.from_rows(rows), 8, 8).model


def pipeline_of(model, text: str) -> Pipeline:
    return build_pipeline(parse(text, "test.toml"), thesis_grid(), model, "synchronous")


def frame(ms: int, model, inclination: float = 0.5) -> HallFrame:
    ideal = dipole_field(np.full(64, inclination), np.zeros(64))
    # Every made whisker has its own strength: scale to its rest field.
    field = ideal * (model.rest_mT[:, 2] / dipole_field(np.zeros(1), np.zeros(1))[0, 2])[:, None]
    # Readings without any noise would count as stuck.
    field = field + np.random.default_rng(ms).normal(0.0, 0.05, field.shape)
    return HallFrame(ms * MS, field.reshape(8, 8, 3), np.ones((8, 8), dtype=bool))


def feed(pipeline: Pipeline, model, until_ms: int, *, screws_until_ms: int, gyro=(0.0, 0.0, 0.0)) -> list[FrameResult]:
    """IMU at 100 Hz, screws at 50 Hz until a time, frames at 25 Hz."""
    results = []
    for ms in range(0, until_ms, 10):
        results += pipeline.add("imu", ImuSample(ms * MS, np.array(gyro), np.array([0, 0, 9.81])))
        if ms % 20 == 0 and ms < screws_until_ms:
            results += pipeline.add("screws", ScrewAngles(ms * MS, np.full(4, 0.0)))
        if ms % 40 == 0:
            results += pipeline.add("whiskers", frame(ms, model))
    return results


def test_a_robot_whose_screws_fall_silent_is_lost_and_says_so(model):
    pipeline = pipeline_of(model, "")
    states = {r.stamp_ns // MS: r.state for r in feed(pipeline, model, 6000, screws_until_ms=2000)}
    assert states[1000] == "tracking"
    assert states[3800] == "tracking"
    assert states[4200] == "lost"


def test_the_first_poses_are_known_even_before_the_first_odometry(model):
    pipeline = pipeline_of(model, "")
    states = [pipeline.add("whiskers", frame(ms, model))[0].state for ms in range(0, 3000, 40)]
    assert states[0] == "tracking"
    assert states[-1] == "lost"


def test_without_slam_the_pose_in_map_is_the_odometry(model):
    results = feed(pipeline_of(model, "[slam]\nmethod = 'none'"), model, 1000, screws_until_ms=1000)
    assert len(results) == 25
    assert {r.state for r in results} == {"dead_reckoning"}
    for result in results:
        np.testing.assert_array_equal(result.T_map_base, result.T_odom_base)


def test_contacts_come_from_bent_whiskers_only(model):
    pipeline = pipeline_of(model, "")
    (bent,) = pipeline.add("whiskers", frame(0, model, 0.5))
    (free,) = pipeline.add("whiskers", frame(40, model, 0.0))
    assert len(bent.contacts.index) == 64
    np.testing.assert_allclose(bent.contacts.points[:, 2], -0.15 * np.cos(0.5), atol=0.002)
    assert len(free.contacts.index) == 0


def test_frames_of_another_size_and_out_of_order_are_counted_not_used(model):
    pipeline = pipeline_of(model, "")
    assert pipeline.add("whiskers", HallFrame(0, np.ones((2, 2, 3)), np.ones((2, 2), dtype=bool))) == []
    assert pipeline.wrong_size_frames == 1
    assert len(pipeline.add("whiskers", frame(80, model))) == 1
    assert pipeline.add("whiskers", frame(60, model)) == []
    assert pipeline.stale_frames == 1


def test_a_turned_imu_is_turned_back(model):
    text = '[[device]]\nname = "imu"\nport = "/dev/x"\nmount_rpy_deg = [180, 0, 0]\n'
    turned = feed(pipeline_of(model, text), model, 2000, screws_until_ms=0, gyro=(0.0, 0.0, -0.3))
    assert turned[-1].odometry.yaw == pytest.approx(0.3 * turned[-1].stamp_ns * 1e-9, abs=0.02)


def test_rezero_and_localize(model):
    pipeline = pipeline_of(model, "[slam]\nmethod = 'none'")
    assert not pipeline.rezero()
    pipeline.add("whiskers", frame(0, model, 0.1))
    assert pipeline.rezero()
    (after,) = pipeline.add("whiskers", frame(40, model, 0.1))
    assert len(after.contacts.index) == 0
    pipeline.localize(1.0, -2.0, 0.5)
    (placed,) = pipeline.add("whiskers", frame(80, model))
    np.testing.assert_allclose(placed.T_map_base[:2, 3], [1.0, -2.0], atol=1e-9)


def test_the_covariance_never_falls_to_zero_once_the_robot_has_moved(model):
    pipeline = pipeline_of(model, "")
    matrix_angle = np.array([-1.0, -1.0, 1.0, 1.0]) * 0.15 / (0.078 * np.tan(np.deg2rad(30.0)))
    variances = []
    for ms in range(0, 6000, 10):
        results = pipeline.add("imu", ImuSample(ms * MS, np.zeros(3), np.array([0, 0, 9.81])))
        if ms % 20 == 0:
            results += pipeline.add("screws", ScrewAngles(ms * MS, matrix_angle * ms * 1e-3))
        if ms % 40 == 0:
            results += pipeline.add("whiskers", frame(ms, model))
        variances += [result.covariance[0, 0] for result in results if result.odometry.x > 0.01]
    assert pipeline.runner is not None
    assert len(variances) > 100
    assert min(variances) > 1e-8
