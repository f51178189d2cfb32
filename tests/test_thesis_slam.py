"""The thesis's pipeline on a made world: touches of a rough surface, odometry that drifts."""

from __future__ import annotations

import numpy as np
import pytest

from robominer_slam.configuration.model import ThesisSection
from robominer_slam.slam.backend_runner import SynchronousRunner, ThreadedRunner
from robominer_slam.slam.composite_scan import CompositeScan, voxel_filter
from robominer_slam.slam.fitness_information import information_from_fitness
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.slam.registration import ScanTarget, register
from robominer_slam.slam.thesis import ThesisBackend
from tests.conftest import planar

#: The made drive is short and rough: closures after 1 m, and no dependence on the defaults that a search has found.
ROUGH = ThesisSection(min_travel=1.0, correspondence_distance=0.1, closure_spacing=0.3, odometry_sigma=0.01)


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A surface with a relief of 10 cm at several lengths, in metres: rough, for this method needs it."""
    rng = np.random.default_rng(11)
    z = np.zeros_like(x)
    for _ in range(40):
        kx, ky = rng.normal(0, 9, 2)
        z += 0.012 * np.cos(kx * x + ky * y + rng.uniform(0, 7))
    return z


def touches(x: float, y: float, yaw: float, rng: np.random.Generator) -> np.ndarray:
    """Contact points in base_link of a 0.5 x 0.3 m array that stands at (x, y, yaw)."""
    u, v = rng.uniform(-0.25, 0.25, 60), rng.uniform(-0.15, 0.15, 60)
    c, s = np.cos(yaw), np.sin(yaw)
    z = height(x + c * u - s * v, y + s * u + c * v) + rng.normal(0, 0.001, 60)
    return np.column_stack([u, v, z])


def drive(steps: int = 700) -> list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """(stamp, true pose, odometry's pose, contacts) on two rounds of a circle of 0.6 m; the odometry drifts."""
    rng = np.random.default_rng(2)
    frames = []
    drift_x, drift_yaw = 0.0, 0.0
    for i in range(steps):
        a = 4 * np.pi * i / steps
        truth = (0.6 * np.sin(a), 0.6 * (1 - np.cos(a)), a)
        drift_x += 0.00025
        drift_yaw += 0.00008
        T_odom = planar(drift_x, 0.0, drift_yaw) @ planar(*truth)
        frames.append((i * 40_000_000, planar(*truth), T_odom, touches(*truth, rng)))
    return frames


def run(runner) -> tuple[np.ndarray, np.ndarray, list[BackendResult]]:
    """Errors of odometry and SLAM per frame, m, and the results as they took effect."""
    composite = CompositeScan(0.12, 1.54, 0.02)
    T_map_odom, odometry, slam, results = np.eye(4), [], [], []
    for stamp, truth, T_odom, points in drive():
        for result in runner.due(stamp):
            T_map_odom = result.T_map_odom
            results.append(result)
        keyframe = composite.add(stamp, T_odom, points)
        if keyframe is not None:
            runner.submit(keyframe)
        odometry.append(np.linalg.norm((T_odom - truth)[:2, 3]))
        slam.append(np.linalg.norm((T_map_odom @ T_odom - truth)[:2, 3]))
    results += runner.close()
    return np.array(odometry), np.array(slam), results


def test_closures_bound_the_drift_and_replay_repeats_bit_for_bit():
    odometry, slam, results = run(SynchronousRunner(ThesisBackend(ROUGH), 500_000_000))
    again = run(SynchronousRunner(ThesisBackend(ROUGH), 500_000_000))
    assert sum(result.closures for result in results) >= 3
    assert slam[-100:].mean() < 0.9 * odometry[-100:].mean()
    np.testing.assert_array_equal(slam, again[1])
    np.testing.assert_array_equal(results[-1].poses, again[2][-1].poses)


def test_results_take_effect_at_a_sensor_time_whoever_computes_them():
    def effects(runner) -> list[tuple[int, int]]:
        seen = []
        for i in range(4):
            runner.submit(Keyframe(i, i * 1_000_000_000, np.eye(4), np.zeros((3, 3)), float(i)))
        for stamp in range(0, 5_000_000_000, 100_000_000):
            seen += [(stamp, result.keyframe.id) for result in runner.due(stamp)]
        return seen

    synchronous = effects(SynchronousRunner(ThesisBackend(ROUGH), 500_000_000))
    assert synchronous == [(500_000_000 + i * 1_000_000_000, i) for i in range(4)]


class _Failing:
    def process(self, keyframe: Keyframe) -> BackendResult:
        raise ZeroDivisionError(f"broken back-end at keyframe {keyframe.id}")


def test_a_failing_backend_thread_is_not_swallowed():
    runner = ThreadedRunner(_Failing(), 0, 4)
    runner.submit(Keyframe(0, 0, np.eye(4), np.zeros((3, 3)), 0.0))
    with pytest.raises(RuntimeError, match="back-end failed") as error:
        runner.close()
    assert isinstance(error.value.__cause__, ZeroDivisionError)


class _Gated:
    """A back-end that waits until the test lets it go."""

    def __init__(self) -> None:
        import threading

        self.gate = threading.Event()
        self.inner = ThesisBackend(ThesisSection())

    def process(self, keyframe: Keyframe) -> BackendResult:
        assert self.gate.wait(10)
        return self.inner.process(keyframe)


def test_late_results_take_effect_when_ready_and_are_counted():
    backend = _Gated()
    runner = ThreadedRunner(backend, 500_000_000, 4)
    runner.submit(Keyframe(0, 0, np.eye(4), np.zeros((3, 3)), 0.0))
    assert runner.due(400_000_000) == []
    assert runner.late == 0
    assert runner.due(600_000_000) == []
    assert runner.due(700_000_000) == []
    assert (runner.late, runner.max_late_ns) == (1, 200_000_000)
    backend.gate.set()
    assert [result.keyframe.id for result in runner.close()] == [0]


def test_composite_scan_completes_by_distance_along_one_axis_or_by_heading():
    composite = CompositeScan(0.12, 1.54, 0.0)
    points = np.array([[0.1, 0.0, -0.1]])
    assert composite.add(0, planar(0, 0, 0), points) is None
    assert composite.add(1, planar(0.1, 0.1, 0), points) is None
    keyframe = composite.add(2, planar(0.1, 0.121, 0), points)
    assert keyframe is not None
    np.testing.assert_allclose(
        keyframe.points, [[0.0, -0.121, -0.1], [0.1, -0.021, -0.1], [0.1, 0.0, -0.1]], atol=1e-12
    )
    assert composite.add(3, planar(0.1, 0.121, 1.5), points) is None
    assert composite.add(4, planar(0.1, 0.121, 1.6), points) is not None


def test_standing_still_does_not_fill_the_memory():
    composite = CompositeScan(0.12, 1.54, 0.0)
    rng = np.random.default_rng(0)
    for i in range(1000):
        composite.add(i, planar(0, 0, 0), rng.normal(size=(50, 3)))
    keyframe = composite.add(1000, planar(0.2, 0, 0), np.zeros((1, 3)))
    assert keyframe is not None
    assert len(keyframe.points) == 51


@pytest.mark.parametrize("matcher", ["ICP", "PLANE_ICP", "GICP", "VGICP"])
def test_every_matcher_finds_a_small_displacement(matcher):
    rng = np.random.default_rng(1)
    scans = []
    for _ in range(2):
        x, y = rng.uniform(-0.4, 0.4, 900), rng.uniform(-0.3, 0.3, 900)
        scans.append(np.column_stack([x, y, height(x, y)]))
    T = planar(0.02, -0.015, 0.03)
    source = (scans[1] - T[:3, 3]) @ T[:3, :3]
    match = register(ScanTarget(scans[0], matcher, 0.1), ScanTarget(source, matcher, 0.1), np.eye(4), matcher, 0.3)
    assert np.linalg.norm((match.T_target_source - T)[:2, 3]) < 0.02 if matcher == "ICP" else 0.006
    assert match.fitness < 4e-4


def test_voxel_filter_takes_the_mean_of_each_voxel():
    points = np.array([[0.01, 0.01, 0.0], [0.03, 0.03, 0.02], [0.26, 0.0, 0.0]])
    filtered = voxel_filter(points, 0.1)
    np.testing.assert_allclose(sorted(filtered.tolist()), [[0.02, 0.02, 0.01], [0.26, 0.0, 0.0]], atol=1e-9)


def test_information_falls_with_the_fitness():
    good, bad = information_from_fitness(0.0), information_from_fitness(0.5)
    np.testing.assert_allclose(np.diag(good), [100.0] * 3 + [400.0] * 3)
    np.testing.assert_allclose(np.diag(bad), [0.04] * 3 + [25.0] * 3)
