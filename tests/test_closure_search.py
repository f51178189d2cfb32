"""The search for a keyframe's place on old ground: right places with honest covariances, wrong ones refused."""

from __future__ import annotations

import numpy as np
import pytest

from robominer_slam import geometry
from robominer_slam.configuration.robust_slam_section import ClosureSection
from robominer_slam.slam.closure_search import Closure, ClosureSearch
from robominer_slam.slam.patch import Patch
from tests.touched_ground import MODEL, corridor, flat, repeated, rough, touches

SECTION = ClosureSection()
HALF = (0.25, 0.16)
#: Keyframes of the old pass: five along x, a quarter of a metre apart.
PASS = {k: np.array([0.25 * k - 0.5, 0.0, 0.0]) for k in range(5)}
ANCHOR, NEW = 2, 9


def found(
    height, seed: int, truth=(0.05, 0.03, 0.04), *, off=(0.0, 0.0, 0.0), sigma=(0.08, 0.08, 0.05), source_height=None,
    dz: float = 0.0, whisker_sigma: float = 0.0, spoilt: float = 0.0, **section: float,
) -> Closure | None:  # fmt: skip
    """Search for a keyframe at `truth`, seen from the anchor, that is predicted `off` beside it.

    Whiskers are 64 fields of the array; each has an error of its own in all touches of both passes.
    """
    rng = np.random.default_rng(seed)
    errors = np.random.default_rng(seed + 1).normal(0, whisker_sigma, (8, 8))

    def touched(ground, count: int, pose) -> np.ndarray:
        points = touches(ground, rng, count, HALF, pose)
        u, v = (np.floor((points[:, k] / HALF[k] + 1.0) * 4.0).astype(int) for k in (0, 1))
        return points + np.column_stack([np.zeros((count, 2)), errors[u, v]])

    patches = {k: Patch(touched(height, 500, pose), 0.25 * k) for k, pose in PASS.items()}
    truth = np.array(truth)
    source = touched(source_height or height, 700, truth) - [0.0, 0.0, dz]
    source[rng.random(700) < spoilt, 2] += 0.05
    covariance = np.diag(np.square(sigma))
    return ClosureSearch(ClosureSection(**section), MODEL).find(
        Patch(source, 10.0), NEW, list(PASS), patches, PASS, dz, truth + off, covariance, np.zeros((3, 3)), ANCHOR
    )


def normalised(closure: Closure, truth) -> float:
    error = geometry.se2_log(geometry.se2_compose(geometry.se2_inverse(np.array(truth)), closure.Z))
    return float(error @ np.linalg.solve(closure.covariance, error))


# The floor alone covers errors that are the same in all touches; without it the touches' own information must.
@pytest.mark.parametrize(("seeds", "section"), [(100, {}), (50, {"floor": 0.0, "floor_yaw_deg": 0.0})])
def test_right_places_are_accepted_with_honest_covariances(seeds, section):
    accepted = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed + 500)
        truth, off = rng.uniform(-1, 1, 3) * [0.2, 0.1, 0.3], rng.normal(0, [0.08, 0.08, 0.05])
        closure = found(rough(seed, relief=0.025), seed, truth, off=off, whisker_sigma=0.0012, **section)
        if closure is not None and closure.good:
            accepted.append((normalised(closure, truth), closure))
    squared = np.array([s for s, _ in accepted])
    assert len(accepted) > 0.7 * seeds
    assert (squared < 7.8).mean() > 0.94, "95 % of a chi-square of three lie below 7.8"
    for _, closure in accepted:
        assert np.sqrt(np.linalg.eigvalsh(closure.covariance[:2, :2])[-1]) <= SECTION.max_sigma + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_flat_ground_is_no_place(seed):
    closure = found(flat, seed)
    assert closure is None or not closure.good


@pytest.mark.parametrize("seed", range(5))
def test_a_corridor_leaves_the_place_along_it_free(seed):
    for uniqueness in (SECTION.uniqueness, 1.0):
        closure = found(corridor, seed, off=(0.1, 0.0, 0.0), sigma=(0.15, 0.05, 0.05), uniqueness=uniqueness)
        assert closure is not None
        assert not closure.good
        assert closure.covariance[0, 0] > SECTION.max_sigma**2


@pytest.mark.parametrize("seed", range(5))
def test_of_two_equal_places_neither_is_taken(seed):
    closure = found(repeated(0.2), seed, sigma=(0.15, 0.05, 0.05))
    assert closure is not None
    assert closure.uniqueness < SECTION.uniqueness
    assert not closure.good


@pytest.mark.parametrize("seed", range(5))
def test_other_ground_is_refused(seed):
    closure = found(rough(seed), seed, source_height=rough(seed + 50))
    assert closure is None or not closure.good


def test_a_place_where_many_touches_do_not_fit_is_refused():
    clean, some, many = (found(rough(2), 2, spoilt=share) for share in (0.0, 0.1, 0.3))
    assert [c is not None and c.good for c in (clean, some, many)] == [True, True, False]


def test_a_place_far_from_the_prediction_is_refused_however_well_it_fits():
    near = found(rough(2), 2, off=(0.1, 0.0, 0.0), sigma=(0.05, 0.05, 0.05))
    far = found(rough(2), 2, off=(0.1, 0.0, 0.0), sigma=(0.015, 0.015, 0.05))
    assert near is not None
    assert near.good
    assert far is not None
    assert far.moved > SECTION.max_moved
    assert not far.good


def test_ground_that_was_not_touched_before_is_no_place():
    assert found(rough(1), 1, truth=(3.0, 0.0, 0.0)) is None
    beside = found(rough(1), 1, truth=(0.0, 0.28, 0.0))
    assert beside is None or not beside.good


def test_the_height_of_the_keyframe_is_told_too():
    closure = found(rough(2), 2, dz=0.4)
    assert closure is not None
    assert closure.dz == pytest.approx(0.4, abs=0.001)


def test_the_patchs_own_drift_adds_to_the_covariance():
    rng = np.random.default_rng(0)
    patches = {k: Patch(touches(rough(0), rng, 500, HALF, pose), 0.25 * k) for k, pose in PASS.items()}
    source = touches(rough(0), rng, 700, HALF)
    search, prior, drift = ClosureSearch(SECTION, MODEL), np.diag([0.01, 0.01, 0.003]), np.diag([4e-4, 1e-4, 1e-4])
    without, with_drift = (
        search.find(Patch(source, 10.0), NEW, list(PASS), patches, PASS, 0.0, np.zeros(3), prior, patch, ANCHOR)
        for patch in (np.zeros((3, 3)), drift)
    )
    assert without is not None
    assert with_drift is not None
    np.testing.assert_allclose(with_drift.covariance - without.covariance, drift, atol=2e-6)


def test_passes_are_told_apart_and_come_nearest_first():
    patches, poses = {}, {}
    for k in range(60):  # there and back on two lines, then near the start again
        along = 0.25 * (k if k < 20 else 39 - k if k < 40 else k - 40)
        poses[k] = np.array([along, 0.0 if k < 20 else 0.3 if k < 40 else 0.1, 0.0])
        patches[k] = Patch(np.zeros((0, 3)), 0.25 * k)
    passes = ClosureSearch(SECTION, MODEL).passes(50, patches, poses, 0.1)
    assert [set(p) <= set(range(20)) for p in passes] == [True, False]
    assert all(p == sorted(p) for p in passes)
    assert max(max(p) for p in passes) <= 50 - SECTION.min_travel / 0.25
    for k in passes[0]:
        assert np.hypot(*(poses[k] - poses[50])[:2]) <= SECTION.target_radius + 0.1
    assert ClosureSearch(SECTION, MODEL).passes(5, patches, poses, 0.1) == []
