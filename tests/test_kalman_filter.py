"""Our Kalman filter against filterpy's, and against Joseph's form with whole matrices."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from robominer_slam.estimation.kalman_filter import KalmanFilter
from robominer_slam.estimation.planar_filter import PlanarFilter
from robominer_slam.estimation.planar_motion import SLIP, Inputs, MotionNoise, step

N = 17


def started(seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N, N))
    return rng, 0.3 * rng.normal(size=N), root @ root.T


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("m", [1, 3])
def test_an_update_is_filterpys(seed: int, m: int) -> None:
    rng, x, P = started(seed)
    H, R, innovation = rng.normal(size=(m, N)), np.diag(rng.uniform(0.1, 2.0, m)), rng.normal(size=m)
    theirs = ExtendedKalmanFilter(N, m)
    theirs.x, theirs.P = x.copy(), P.copy()
    theirs.update(innovation, lambda _: H, lambda _: np.zeros(m), R)
    ours = KalmanFilter(x.copy(), P.copy())
    distance = ours.correct(innovation, H, R)
    np.testing.assert_allclose(ours.x, theirs.x, atol=1e-12)
    np.testing.assert_allclose(ours.P, theirs.P, atol=1e-11)
    assert distance == pytest.approx(float(theirs.mahalanobis) ** 2)
    assert ours.outliers == 0


@pytest.mark.parametrize("m", [1, 2])
def test_beyond_the_gate_a_measurement_counts_less_and_is_counted(m: int) -> None:
    rng, x, P = started(7)
    H, R, innovation = rng.normal(size=(m, N)), 0.1 * np.eye(m), 100.0 * np.ones(m)
    ours = KalmanFilter(x.copy(), P.copy(), gate=9.0)
    distance = ours.correct(innovation, H, R)
    expected = KalmanFilter(x.copy(), P.copy())
    expected.correct(innovation, H, R * (distance / 9.0))
    np.testing.assert_allclose(ours.x, expected.x, atol=1e-12)
    np.testing.assert_allclose(ours.P, expected.P, atol=1e-12)
    assert distance > 9.0
    assert ours.outliers == 1


@pytest.mark.parametrize("m", [1, 2])
def test_what_is_held_does_not_move_and_the_covariance_is_josephs(m: int) -> None:
    rng, x, P = started(8)
    H, R, innovation = rng.normal(size=(m, N)), 0.5 * np.eye(m), rng.normal(size=m)
    held = np.linalg.qr(rng.normal(size=(N, 3)))[0].T
    ours = KalmanFilter(x.copy(), P.copy())
    ours.correct(innovation, H, R, held)
    np.testing.assert_allclose(held @ ours.x, held @ x, atol=1e-12)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    gain -= held.T @ held @ gain
    left = np.eye(N) - gain @ H
    np.testing.assert_allclose(ours.P, left @ P @ left.T + gain @ R @ gain.T, atol=1e-11)
    assert np.linalg.eigvalsh(ours.P).min() > 0.0


@pytest.mark.parametrize("fading", [1.0, 0.97])
def test_a_prediction_is_filterpys(fading: float) -> None:
    rng, x, P = started(3)
    inputs = Inputs(0.02, 0.3, np.array([0.2, -0.05]), ((0.98, 0.05), (-0.02, 0.99)))
    q, noise = rng.uniform(0.0, 1.0, N), MotionNoise(0.1, 0.05, 0.2, 0.3, 0.4)
    moved = step(x, inputs)
    F, effect = np.eye(N), np.zeros((N, 5))
    F[:6] = moved.by_state
    # Of vx, vy, wz in the interval, and of x and y beside them.
    effect[:2, :3], effect[2, 2] = np.reshape(moved.pose_by_velocity, (2, 3)), inputs.dt
    effect[3:6, :3], effect[:2, 3:] = np.eye(3), np.eye(2)
    Q = np.diag([0.1, 0.2, 0.3, 0.4, 0.4])
    Q[0, 1] = Q[1, 0] = 0.05
    fade = np.ones(N)
    fade[SLIP] = fading
    theirs = ExtendedKalmanFilter(N, 1)
    theirs.P, theirs.F, theirs.Q = P.copy(), F, effect @ Q @ effect.T
    theirs.predict()
    theirs.F, theirs.Q = np.diag(fade), np.diag(q)
    theirs.predict()
    ours = PlanarFilter(x.copy(), P.copy(), 9.0)
    ours.move(inputs, noise)
    ours.walk(q.tolist(), fading)
    np.testing.assert_allclose(ours.P, theirs.P, atol=1e-12)
    np.testing.assert_allclose(ours.x[SLIP], fading * x[SLIP], atol=1e-15)
