"""Bounded maps of several sessions: what goes is gone from map and store, and the sessions stay tied."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.long_drive import drive
from robominer_slam import geometry
from robominer_slam.configuration.bounded_map_section import BoundedMapSection
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.patch_pages import SqlitePages
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.keyframe_nodes import KeyframeNodes
from robominer_slam.slam.keyframe_removal import covered, mergeable, pinned, remove_keyframes
from robominer_slam.slam.level_edges import LevelEdge
from robominer_slam.slam.localised_backend import LocalisedBackend
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.store import MapStore
from robominer_slam.store_reader import load_map
from tests.test_store import rows

CAP = 80
BOUNDS = BoundedMapSection(
    local_window=30, small_map=30, max_keyframes=CAP, max_points_in_memory=20_000, full_every=50
)  # fmt: skip
SECTION = RobustSlamSection(bounds=BOUNDS)


def session(
    keyframes: Sequence[Keyframe], path: Path, known: SavedMap | None = None, map_id: int | None = None
) -> tuple[KeyframeMap, list[BackendResult]]:
    """Keyframes through the back-end into map and store."""
    backend, whole, results = LocalisedBackend(SECTION, known, False, SqlitePages), KeyframeMap(0.01), []
    if known is not None:
        whole.load(known)
    with MapStore(path, 0.05, "rm3", "", map_id) as store:
        for keyframe in keyframes:
            result = backend.process(keyframe)
            whole.take(result)
            store.add(result, 0)
            results.append(result)
            assert len(whole.poses) == len(whole.keyframes)
            assert result.ids == tuple(whole.ids)
        assert store.flush(10.0)
        store.save_poses(whole.poses, whole.ids, whole.edges)
        assert store.dropped == 0
    backend.release()
    return whole, results


def assert_stored(path: Path, whole: KeyframeMap) -> None:
    """The store holds the map: its keyframes, edges, and where there are touches."""
    stored = rows(path, "SELECT id FROM keyframes ORDER BY id")
    assert [row[0] for row in stored] == whole.ids
    assert Counter(rows(path, "SELECT kind, i, j FROM edges")) == Counter((e.kind, e.i, e.j) for e in whole.edges)
    saved = load_map(path)[1]
    assert [bool(len(k.points)) for k in saved.keyframes] == [bool(len(k.points)) for k in whole.keyframes]
    np.testing.assert_allclose(saved.poses, whole.poses, atol=1e-3)


@pytest.fixture(scope="module")
def rounds() -> tuple[list[Keyframe], np.ndarray]:
    pairs = list(drive("rounds", 4, 320))
    return [keyframe for keyframe, _ in pairs], np.array([true for _, true in pairs])


def test_a_bounded_map_is_gone_on_with_and_stays_within_its_bounds(tmp_path, rounds):
    keyframes, truth = rounds
    path = tmp_path / "map.db"
    first, _ = session(keyframes[:150], path)
    assert len(first.keyframes) <= CAP
    assert first.ids != list(range(len(first.ids)))
    assert_stored(path, first)
    map_id, known = load_map(path)
    # The second session begins elsewhere in an odom of its own; all that it was told is the map.
    begin = known.next_id - keyframes[160].id
    origin = geometry.T_from_xyyaw([3.0, -2.0, 1.0]) @ geometry.inverse(keyframes[160].T_odom_base)
    again = [
        replace(k, id=k.id + begin, T_odom_base=origin @ k.T_odom_base, travelled=k.travelled - 40.0)
        for k in keyframes[160:]
    ]
    again[0] = replace(again[0], motion=None)
    second, results = session(again, path, known, map_id)
    assert results[-1].localised
    found = next(n for n, result in enumerate(results) if result.localised)
    assert found < 40
    assert len(results[found].new_keyframes) == found + 1
    assert len(second.keyframes) <= CAP
    removed = {key for result in results for key in result.removed}
    assert any(key in removed for key in known.ids)
    assert any(key > known.ids[-1] for key in removed)
    assert_stored(path, second)
    T_true = geometry.T_from_xyyaw(truth[160:])
    errors = [
        np.hypot(*(result.T_map_odom @ result.keyframe.T_odom_base)[:2, 3] - true[:2, 3])
        for result, true in zip(results[found:], T_true[found:], strict=True)
    ]
    assert np.mean(errors) < 0.06
    assert np.max(errors) < 0.15
    known_again = load_map(path)[1]
    assert known_again.ids == tuple(second.ids)


def two_sessions(ties: int) -> KeyframeGraph:
    """Two straight drives of 40 keyframes side by side, tied by closures only."""
    graph = KeyframeGraph()
    strong = np.eye(3) * 1e5
    for k in range(80):
        row, column = divmod(k, 40)
        graph.nodes.append(k, np.array([0.25 * column, 0.2 * row, 0.0]), 0.0, np.eye(3), 0.25 * k)
        if column:
            Z = np.array([0.25, 0.0, 0.0])
            graph.edges.append(LevelEdge("odometry", k - 1, k, Z, strong, 0.0, 1e5, np.zeros((3, 0)), np.zeros(0)))
    for tie in range(5, 5 + ties):
        Z = np.array([0.0, 0.2, 0.0])
        graph.edges.append(LevelEdge("loop", tie, tie + 40, Z, strong, 0.0, 1e5, np.zeros((3, 0)), np.zeros(0)))
    graph.optimise()
    return graph


def test_sessions_stay_tied_whatever_goes():
    graph = two_sessions(8)
    assert np.flatnonzero(pinned(graph)).tolist() == [0, 5, 39, 40, 45, 79]
    assert not {5, 39, 40, 45} & set(mergeable(graph, {}, 1.0, 10, np.zeros(2)))
    graph.nodes.mapped[:] = False
    gone = covered(graph, 10)
    assert len(gone) > 60
    remove_keyframes(graph, gone)
    graph.optimise()
    assert np.isfinite(graph.covariance([79])).all()
    np.testing.assert_allclose(graph.relative(5, 45), [0.0, 0.2, 0.0], atol=1e-6)


def test_a_closure_that_was_taken_back_ties_nothing():
    graph = two_sessions(8)
    graph.edges.switch(np.flatnonzero(graph.edges.loop)[:3], False)
    assert {8, 48} <= set(np.flatnonzero(pinned(graph)).tolist())


def test_nodes_before_others_keep_the_order_of_ids():
    graph, before = two_sessions(1), KeyframeNodes()
    before.append(-2, np.array([1.0, 2.0, 3.0]), 4.0, np.eye(3), -5.0)
    before.mapped[:] = False
    version = graph.nodes.version
    graph.nodes.put_before(before)
    assert graph.nodes.ids[:2].tolist() == [-2, 0]
    assert graph.nodes.height(-2) == 4.0
    assert graph.nodes.mapped[:2].tolist() == [False, True]
    assert graph.nodes.version > version
    with pytest.raises(ValueError, match="growing ids"):
        graph.nodes.put_before(before)


def test_a_robot_carried_away_in_a_bounded_map_finds_back_and_map_and_store_agree(tmp_path, rounds):
    """Lifted after 150 keyframes, put down 2 m on: what was held back in doubt enters where it belongs."""
    keyframes, truth = rounds
    path = tmp_path / "map.db"
    lifted, on = 150, 8
    step = geometry.inverse(keyframes[lifted - 1].T_odom_base) @ keyframes[lifted].T_odom_base
    origin = keyframes[lifted - 1].T_odom_base @ step @ geometry.inverse(keyframes[lifted + on].T_odom_base)
    after = [
        replace(k, id=k.id - on, T_odom_base=origin @ k.T_odom_base, travelled=k.travelled - 0.25 * on, breaks=1)
        for k in keyframes[lifted + on : 300]
    ]
    whole, results = session([*keyframes[:lifted], *after], path)
    held = [n for n, result in enumerate(results) if not result.new_keyframes]
    assert held
    assert held[0] == lifted
    assert results[-1].localised
    assert len(whole.keyframes) <= CAP
    assert_stored(path, whole)
    entered = [k.id for result in results for k in result.new_keyframes]
    assert entered == list(range(len(results)))
    last = results[-1]
    placed = (last.T_map_odom @ last.keyframe.T_odom_base)[:2, 3]
    assert np.hypot(*(placed - truth[299, :2])) < 0.1
