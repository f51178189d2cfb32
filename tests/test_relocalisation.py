"""Finding the place in a saved map by touch: from anywhere, never too early, and again after being carried away."""

from __future__ import annotations

import numpy as np
import pytest

from robominer_slam.configuration.relocalisation_section import RelocalisationSection
from robominer_slam.slam.doubts import Doubts
from robominer_slam.slam.global_search import GlobalSearch
from robominer_slam.slam.keyframe import Keyframe
from robominer_slam.slam.place_prior import PlacePrior
from robominer_slam.slam.surface_registration import SurfaceMatch, placed
from tests.saved_drives import AWAY, LOOP, TURNED, carried, follow, loop_map, stream


def known_at(followed) -> int:
    """Index of the first frame that is tracking."""
    return next(n for n, frame in enumerate(followed.frames) if frame.state == "tracking")


@pytest.mark.parametrize("way", [TURNED, AWAY])
def test_the_place_is_found_from_any_start_and_not_before_it_is_sure(way):
    followed = follow(stream("thesis", way, 11), loop_map(), "localize")
    first = known_at(followed)
    assert 0.5 < followed.way[first] < 2.5
    assert max(followed.errors[first:]) < 0.05
    assert all(frame.state == "tracking" for frame in followed.frames[first:])
    for frame in followed.frames[:first]:
        assert frame.state == "relocalizing"
        assert np.sqrt(frame.covariance[0, 0]) >= 10.0
        assert np.sqrt(frame.covariance[1, 1]) >= 10.0
    errors = np.array(followed.errors[first:])
    sigmas = np.sqrt([np.trace(frame.covariance[:2, :2]) for frame in followed.frames[first:]])
    assert (sigmas < 0.1).all()
    assert (errors < 5.0 * sigmas + 0.03).all()


@pytest.mark.parametrize("world", ["random:2", "flat", "corridor"])
def test_on_ground_that_is_not_in_the_map_nothing_is_believed(world):
    for start in ("localize", "continue"):
        followed = follow(stream(world, TURNED, 12), loop_map(), start)
        assert {frame.state for frame in followed.frames} == {"relocalizing"}
        assert followed.map.ids == list(loop_map().ids)


def tell(prior: PlacePrior, at_frame: int):
    """A command at a frame."""
    count = [0]

    def on_frame(pipeline, _) -> None:
        count[0] += 1
        if count[0] == at_frame:
            pipeline.localize_by_touch(prior)

    return on_frame


def test_a_right_hint_shortens_the_way():
    drive = stream("thesis", TURNED, 11)
    alone = follow(drive, loop_map(), "localize")
    told = follow(drive, loop_map(), "localize", tell(PlacePrior(0.5, 0.4, 2.2, 0.3, 0.4), 1))
    assert told.way[known_at(told)] < alone.way[known_at(alone)]
    assert max(told.errors[known_at(told) :]) < 0.05


def test_a_wrong_hint_is_not_believed():
    told = follow(stream("thesis", TURNED, 11), loop_map(), "localize", tell(PlacePrior(0.1, 0.0, -1.0, 0.1, 0.2), 1))
    first = known_at(told)
    assert max(told.errors[first:]) < 0.05
    assert all(frame.state == "relocalizing" for frame in told.frames[:first])


def test_a_hint_in_the_map_being_made_ends_the_session_and_ties_it_again():
    """Carried by hand with the operator's word: what comes after is a session of its own in the same map."""
    first, second = stream("thesis", LOOP, 7), stream("thesis", AWAY, 13)
    at = sum(1 for m in first if not hasattr(m, "position") and m[0] == "whiskers") + 1
    followed = follow(carried(first, second), on_frame=tell(PlacePrior(0.3, 0.25, -0.4, 0.2, 0.4), at))
    states = [frame.state for frame in followed.frames]
    assert set(states[: at - 1]) == {"tracking"}
    assert states[at] == "relocalizing"
    assert states[-1] == "tracking"
    assert followed.errors[-1] < 0.05
    assert len(followed.map.ids) == len(set(followed.map.ids))
    ids = set(followed.map.ids)
    assert all(e.i in ids and e.j in ids for e in followed.map.edges)


@pytest.mark.parametrize("start", ["new", "localize"])
def test_a_robot_that_was_carried_away_is_noticed_and_found_again(start):
    known = None if start == "new" else loop_map()
    first = stream("thesis", LOOP if start == "new" else TURNED, 7)
    followed = follow(carried(first, stream("thesis", AWAY, 13)), known, start)
    begin = next(
        n for n in range(1, len(followed.way)) if followed.frames[n].stamp_ns - followed.frames[n - 1].stamp_ns > 5e8
    )
    states = [frame.state for frame in followed.frames]
    errors = np.array(followed.errors)
    assert states[begin - 1] == "tracking"
    wrong = [n for n in range(begin, len(states)) if states[n] == "tracking" and errors[n] > 0.25]
    driven = followed.way[wrong[-1]] - followed.way[begin] if wrong else 0.0
    assert driven < 0.6, "believed where it was for too long"
    assert states[-1] == "tracking"
    assert errors[-1] < 0.05


def test_carrying_leaves_the_map_before_it_intact():
    alone = follow(stream("thesis", LOOP, 7))
    followed = follow(carried(stream("thesis", LOOP, 7), stream("random:2", AWAY, 13)))
    assert followed.frames[-1].state == "relocalizing"
    common = len(alone.map.ids)
    assert followed.map.ids[: common - 1] == alone.map.ids[: common - 1]
    assert len(followed.map.ids) <= common + 1
    np.testing.assert_allclose(followed.map.poses[: common - 1], alone.map.poses[: common - 1], atol=0.01)


def keyframe(k: int, breaks: int) -> Keyframe:
    return Keyframe(k, k, np.eye(4), np.zeros((0, 3)), 0.25 * k, breaks=breaks)


def match(inliers: float, overlap: float = 1.0) -> SurfaceMatch:
    """Of touches on ground with a relief of 1 cm."""
    heights = np.array([[0.0, 0.0, 0.01], [1.0, 0.0, -0.01], [0.0, 1.0, -0.01], [1.0, 1.0, 0.01]])
    return SurfaceMatch(
        pose=np.zeros(4), information=np.eye(4), curvature=np.eye(4), gradient=np.zeros(4), overlap=overlap,
        inliers=inliers, rms=0.002, cost=4e-6, heights=heights,
    )  # fmt: skip


def judged(doubts: Doubts, k: int, breaks: int, found: SurfaceMatch | None, closed: bool = False) -> None:
    doubts.notice(keyframe(k, breaks))
    doubts.judge(found, closed)


def test_changed_ground_alone_is_no_reason_to_give_the_place_up():
    doubts = Doubts(RelocalisationSection())
    for k in range(100):
        judged(doubts, k, 0, match(0.1))
        assert not doubts.carried_away


def test_where_the_place_is_unsure_ground_that_does_not_fit_raises_no_doubt_unless_it_broke():
    doubts, unsure = Doubts(RelocalisationSection()), np.diag([0.2**2, 0.01**2, 0.1**2])
    assert doubts.are_sensible(0.01 * unsure)
    assert not doubts.are_sensible(unsure)
    judged(doubts, 0, 0, match(1.0))
    judged(doubts, 1, 1, match(0.3))
    assert doubts.are_sensible(unsure)


def test_a_break_means_carried_away_once_the_map_contradicts_or_nothing_explains_it():
    doubts = Doubts(RelocalisationSection())
    judged(doubts, 0, 0, match(1.0))
    judged(doubts, 1, 1, match(0.3))
    assert doubts.broken
    for k in range(2, 5):
        assert doubts.broken
        judged(doubts, k, 1, match(0.95))
    assert not doubts.any
    for k in range(5, 7):
        judged(doubts, k, 2, match(0.3))
    assert doubts.carried_away
    doubts = Doubts(RelocalisationSection())
    for k in range(10):
        judged(doubts, k, int(k > 3), match(0.1, overlap=0.2))
        assert not doubts.carried_away
    for k in range(10, 13):
        judged(doubts, k, 1, None, closed=True)
    assert not doubts.any
    for k in range(13, 30):
        judged(doubts, k, 2, None)
    assert doubts.carried_away


def test_a_map_without_touches_has_no_place_for_anything():
    search = GlobalSearch(np.zeros((0, 3)), 0.06, 1.0)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))
    assert len(search.find(points, 0.2, 0.5, 4).poses) == 0


def test_after_a_way_over_unmapped_ground_a_frozen_map_is_entered_by_search_alone():
    """Over there odometry drifts: the sigma says so, no match near the prediction is taken, and it is found again."""
    places = ((0.6, 0.1), (0.2, 0.3), (0.7, 0.3), (0.3, 0.1), (0.3, 1.3), (1.3, 1.3), (1.3, 0.9), (0.5, 0.3),
              (0.05, 0.3), (0.6, 0.1))  # fmt: skip
    out_and_back = tuple((x, y, 0.0) for x, y in places)
    followed = follow(stream("thesis", out_and_back, 14), loop_map(), "localize")
    first = known_at(followed)
    errors = np.array(followed.errors[first:])
    sigmas = np.sqrt([np.trace(frame.covariance[:2, :2]) for frame in followed.frames[first:]])
    assert (errors < 4.0 * sigmas + 0.03).all()
    assert followed.frames[-1].state == "tracking"
    assert errors[-1] < 0.05


def test_the_search_finds_a_patch_in_a_map_at_any_heading_and_height():
    rng = np.random.default_rng(3)
    waves = rng.uniform(4.0, 15.0, (12, 2)) * rng.choice([-1, 1], (12, 2))
    phase = rng.uniform(0, 6.28, 12)

    def ground(xy):
        return 0.008 * np.cos(xy @ waves.T + phase).sum(axis=1)

    xy = rng.uniform(-1.5, 1.5, (30_000, 2))
    touches = np.column_stack([xy, ground(xy)])
    search = GlobalSearch(touches, 0.06, 1.0)
    assert search.area == pytest.approx(9.0, rel=0.25)
    for x, y, yaw in ((0.4, -0.3, 1.0), (-0.7, 0.5, -2.5)):
        local = rng.uniform(-0.35, 0.35, (400, 2))
        pose = np.array([x, y, yaw, 0.0])
        world = placed(np.column_stack([local, np.zeros(400)]), pose)
        points = np.column_stack([local, ground(world[:, :2]) - 0.2])
        best = search.find(points, np.deg2rad(7.5), 0.5, 4)
        assert np.hypot(*(best.poses[0][:2] - pose[:2])) < 0.09
        assert abs((best.poses[0][2] - yaw + np.pi) % (2 * np.pi) - np.pi) < 0.12
        assert best.poses[0][3] == pytest.approx(0.2, abs=0.01)
        assert best.score[0] > best.score[1]
