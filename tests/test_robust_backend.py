"""The back-end `robust` with closures that are told to it: agreement, taking back, return, biases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robominer_slam import geometry as g
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.estimation.keyframe_motion import KeyframeMotion
from robominer_slam.slam.closure_search import Closure
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.slam.robust import RobustBackend
from robominer_slam.slam.surface_registration import SurfaceMatch

SECTION = RobustSlamSection()
#: Twenty keyframes make a round.
STEP = np.array([0.25, 0.0, np.pi / 10])
ROUND = 20
SIGMA = np.array([0.01, 0.01, 0.02])
MATCH = SurfaceMatch(np.zeros(4), np.eye(4), np.eye(4), np.zeros(4), 1.0, 1.0, 0.001, 1e-6, np.zeros((0, 3)))
SECONDS = 2.0
#: Of an odometry step, where closures must be told apart by it.
TIGHT, LOOSE = (0.003, 0.003, 0.002), (0.005, 0.005, 0.004)


def truth(i: int, j: int) -> np.ndarray:
    """Pose of keyframe j in keyframe i."""
    return g.se2_exp(STEP * (j - i))


def closure(i: int, j: int, off=(0.0, 0.0, 0.0), sigma=SIGMA) -> Closure:
    """A closure that puts j beside its place, by the same way in map for all with the same `off`."""
    Z = g.se2_compose(g.se2_compose(truth(i, 0), np.array(off, dtype=float)), truth(0, j))
    return Closure(i, j, Z, np.diag(np.square(sigma)), 0.0, MATCH, np.inf, 0.0, True)


class ToldSearch:
    """Finds what it was told, for the keyframe that it was told for."""

    def __init__(self, closures: list[Closure]) -> None:
        self._closures = closures

    def passes(self, new: int, *_: object) -> list[list[int]]:
        return [[c.i] for c in self._closures if c.j == new]

    def find(self, _source: object, new: int, targets: list[int], *_: object) -> Closure:
        return next(c for c in self._closures if (c.i, c.j) == (targets[0], new))


def drive(
    closures: list[Closure], n: int, *, section: RobustSlamSection = SECTION, bias=(0.0, 0.0, 0.0),
    sigma=(0.02, 0.02, 0.02), noise: float = 0.0,
) -> list[BackendResult]:  # fmt: skip
    """Results of n keyframes on a circle, by an odometry with a bias, white noise, and the sigma that it claims."""
    rng = np.random.default_rng(0)
    backend = RobustBackend(section)
    backend._search = ToldSearch(closures)
    T, points = np.eye(4), rng.uniform(-0.2, 0.2, (100, 3))
    results = []
    for k in range(n):
        motion = None
        if k:
            eta = np.array(bias) * SECONDS + noise * rng.normal(size=3) * np.array(sigma)
            T_step = g.T_from_xyyaw(g.se2_compose(g.se2_exp(STEP), g.se2_exp(eta)))
            T = T @ T_step
            covariance = np.diag(np.square([*sigma[:2], 0.002, 0.002, 0.002, sigma[2]]))
            J = np.zeros((6, 3))
            J[[0, 1, 5], [0, 1, 2]] = -SECONDS
            motion = KeyframeMotion(k, T_step, covariance, J, np.zeros(3), np.zeros(3), np.eye(3) * 0.004**2)
        results.append(backend.process(Keyframe(k, k, T, points, 0.25 * k, motion)))
    return results


def loops(result: BackendResult) -> dict[tuple[int, int], float]:
    """Weights of the closures in the graph."""
    return {(e.i, e.j): e.weight for e in result.edges if e.kind == "loop"}


def error(result: BackendResult, k: int) -> float:
    return float(np.hypot(*(g.xyyaw_of(g.inverse(result.poses[0]) @ result.poses[k]) - truth(0, k))[:2]))


def test_a_single_closure_waits_for_another_that_agrees():
    results = drive([closure(1, 21), closure(3, 23)], 25)
    assert loops(results[21]) == {}
    assert results[21].closures == 0
    assert loops(results[23]) == {(1, 21): 1.0, (3, 23): 1.0}
    assert results[23].closures == 2


def test_closures_that_contradict_each_other_both_wait():
    results = drive([closure(1, 21), closure(2, 22, (0.2, 0.0, 0.0))], 25)
    assert loops(results[-1]) == {}


def test_two_of_the_same_keyframe_are_no_witnesses_of_each_other():
    results = drive([closure(1, 21), closure(2, 21)], 25)
    assert loops(results[-1]) == {}


def test_a_witness_must_not_be_too_far_away():
    span = SECTION.closure.partner_span
    assert len(loops(drive([closure(1, 21), closure(1 + span, 21 + span)], 30)[-1])) == 2
    assert len(loops(drive([closure(1, 21), closure(2 + span, 22 + span)], 30)[-1])) == 0


@pytest.mark.parametrize("off", [(0.15, 0.0, 0.0), (0.0, -0.12, 0.0), (0.0, 0.0, 0.2)])
def test_a_false_closure_among_true_ones_is_not_accepted(off):
    told = [closure(k, k + ROUND) for k in (0, 1, 2, 4, 5)] + [closure(3, 23, off)]
    results = drive(told, 28, bias=(0.002, 0.003, 0.002), sigma=TIGHT)
    assert loops(results[-1]) == {(k, k + ROUND): 1.0 for k in (0, 1, 2, 4, 5)}


def test_closures_that_the_rest_contradicts_are_taken_back():
    false = [closure(k, k + ROUND, (0.3, 0.0, 0.0)) for k in (0, 1)]
    true = [closure(k, k + ROUND) for k in range(6, 13)]
    results = drive(false + true, 34, sigma=LOOSE)
    assert loops(results[21]) == {(0, 20): 1.0, (1, 21): 1.0}, "they agree, and nothing else is known yet"
    weights = loops(results[-1])
    assert [weights[0, 20], weights[1, 21]] == [0.0, 0.0]
    assert all(weights[k, k + ROUND] == 1.0 for k in range(6, 13))
    assert error(results[-1], 33) < 0.03


def test_a_closure_taken_back_returns_when_the_graph_no_longer_contradicts_it():
    # Two wrong ones that are very sure push out two right ones, until the right ones are many.
    false = [closure(k, k + ROUND, (0.3, 0.0, 0.0), sigma=0.3 * SIGMA) for k in (0, 1)]
    first = [closure(k, k + ROUND) for k in (2, 3)]
    more = [closure(k, k + ROUND, sigma=0.2 * SIGMA) for k in range(4, 14)]
    results = drive(false + first + more, 35, sigma=LOOSE)
    early, late = loops(results[23]), loops(results[-1])
    assert [early[k, k + ROUND] for k in range(4)] == [1.0, 1.0, 0.0, 0.0]
    assert [late[k, k + ROUND] for k in range(4)] == [0.0, 0.0, 1.0, 1.0]


def test_loops_close_the_drift_and_teach_the_bias_for_the_way_ahead():
    bias = (0.0, 0.0, 0.004)
    told = [closure(k, k + ROUND) for k in range(8)]
    alone, closed = (drive(closures, 40, bias=bias, sigma=TIGHT) for closures in ([], told))
    assert error(alone[-1], 39) > 0.1
    assert error(closed[28], 27) < 0.1 * error(alone[28], 27)
    # After the last closure twelve keyframes more: without what was learned they would drift as before.
    assert error(closed[-1], 39) < 0.25 * error(alone[-1], 39)
    assert closed[-1].covariance[0, 0] < alone[-1].covariance[0, 0]


def test_biases_may_be_left_to_the_odometry():
    section = SECTION.model_copy(update={"bias_unknown": False})
    results = drive([closure(k, k + ROUND) for k in range(4)], 26, section=section, bias=(0.004, 0.0, 0.002))
    assert len(loops(results[-1])) == 4
    assert error(results[-1], 24) < 0.1


def test_without_closures_the_map_is_odom_and_the_covariance_grows():
    results = drive([], 10, noise=1.0)
    for result in results:
        np.testing.assert_allclose(result.T_map_odom, np.eye(4), atol=1e-9)
        np.testing.assert_allclose(result.poses[-1], result.keyframe.T_odom_base, atol=1e-9)
    assert np.all(np.diff([result.covariance[0, 0] for result in results]) > 0.0)


def test_closing_may_be_turned_off():
    section = SECTION.model_copy(update={"closure": SECTION.closure.model_copy(update={"enabled": False})})
    assert loops(drive([closure(k, k + ROUND) for k in range(4)], 26, section=section)[-1]) == {}


def test_the_same_keyframes_give_the_same_graph_bit_for_bit():
    told = [closure(k, k + ROUND) for k in range(6)]
    first, again = (drive(told, 30, bias=(0.002, 0.0, 0.001), noise=1.0)[-1] for _ in range(2))
    np.testing.assert_array_equal(first.poses, again.poses)
    np.testing.assert_array_equal(first.covariance, again.covariance)


def test_an_odometry_that_does_not_tell_its_motion_is_refused():
    backend = RobustBackend(SECTION)
    frame = Keyframe(0, 0, np.eye(4), np.zeros((3, 3)), 0.0)
    backend.process(frame)
    with pytest.raises(ValueError, match="motion"):
        backend.process(replace(frame, id=1, stamp_ns=1))
