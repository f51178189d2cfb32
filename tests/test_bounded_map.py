"""Bounded maps: what leaves the graph makes it surer of nothing, and the drive stays as accurate as it was."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.long_drive import drive, run
from robominer_slam import geometry
from robominer_slam.configuration.bounded_map_section import BoundedMapSection
from robominer_slam.configuration.overrides import overridden
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.graph_json import graph_json
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.patch_pages import SqlitePages
from robominer_slam.publishing.map_stream import MapStreamDecoder, MapStreamEncoder
from robominer_slam.replay import prepare, replay
from robominer_slam.slam.covered_ground import covered_share
from robominer_slam.slam.graph_marginals import TrackedCovariance
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.keyframe_removal import mergeable, remove_keyframes
from robominer_slam.slam.level_edges import LevelEdge
from robominer_slam.slam.patch import Patch
from robominer_slam.slam.patch_memory import PatchMemory
from robominer_slam.slam.robust import RobustBackend

RECORDING = Path(__file__).parent / "recordings" / "scenario-1.mcap"
STEP = np.array([0.25, 0.0, 0.1])


def odometry(rng: np.random.Generator, i: int, j: int) -> LevelEdge:
    A = rng.normal(size=(3, 6))
    information = np.linalg.inv(1e-6 * A @ A.T)
    Z = geometry.se2_exp(STEP + rng.normal(0.0, 0.002, 3))
    jacobian = -2.5 * np.eye(3) + rng.normal(0.0, 0.1, (3, 3))
    return LevelEdge("odometry", i, j, Z, information, 0.001, 1e5, jacobian, np.full(3, 1e-4))


def loop(graph: KeyframeGraph, i: int, j: int, off: float) -> LevelEdge:
    Z = geometry.se2_compose(graph.relative(i, j), geometry.se2_exp([off, -off, 0.1 * off]))
    information = np.diag([1e5, 1e5, 1e5])
    return LevelEdge("loop", i, j, Z, information, 0.0, 1e5, np.zeros((3, 3)), np.zeros(3))


def circling(count: int, seed: int = 0, off: float = 0.001) -> KeyframeGraph:
    """A robot that goes round a circle of 63 keyframes, with closures to the round before."""
    rng = np.random.default_rng(seed)
    graph = KeyframeGraph()
    graph.bias = graph.bias_prior = np.full(3, 1e-4)
    graph.bias_prior_information = np.eye(3) * 1e6
    graph.nodes.append(0, np.zeros(3), 0.0, np.eye(3), 0.0)
    for k in range(1, count):
        edge = odometry(rng, k - 1, k)
        graph.edges.append(edge)
        graph.nodes.append(k, geometry.se2_compose(graph.nodes[k - 1], edge.Z), 0.001 * k, np.eye(3), 0.25 * k)
        if k > 63 and k % 4 == 0:
            graph.edges.append(loop(graph, k - 63, k, off))
    graph.optimise()
    return graph


def parts_at(edge: LevelEdge, bias: np.ndarray) -> np.ndarray:
    return geometry.se2_compose(edge.Z, geometry.se2_exp(edge.jacobian @ (bias - edge.reference)))


@pytest.mark.parametrize("gone", [[70], [100, 101, 102, 103], [5, 64, 68, 130]])
def test_removal_never_makes_the_graph_surer(gone: list[int]):
    graph = circling(160, off=0.0)
    stay = [1, 40, 90, 120, 159]
    before = [graph.covariance([k]) for k in stay]
    joint = graph.covariance([40, 159])
    remove_keyframes(graph, gone)
    graph.optimise()
    for k, old in zip(stay, before, strict=True):
        new = graph.covariance([k])
        assert np.linalg.eigvalsh(new - old)[0] >= -1e-4 * np.trace(old)
    assert np.linalg.eigvalsh(graph.covariance([40, 159]) - joint)[0] >= -1e-4 * np.trace(joint)
    assert not set(gone) & set(graph.edges.i.tolist()) | set(gone) & set(graph.edges.j.tolist())


def test_a_keyframe_without_closures_leaves_without_a_trace():
    """Then a composed edge is the exact marginal: poses and covariances of the others stay."""
    graph = circling(160, off=0.002)
    looped = set(graph.edges.i[graph.edges.loop]) | set(graph.edges.j[graph.edges.loop])
    free = [k for k in range(70, 90) if k not in looped]
    covariance, pose = graph.covariance([159]), graph.nodes[159]
    remove_keyframes(graph, free[:4])
    graph.optimise()
    np.testing.assert_allclose(graph.nodes[159], pose, atol=2e-5)
    np.testing.assert_allclose(graph.covariance([159]), covariance, rtol=0.01, atol=1e-9)


def test_the_first_and_the_last_keyframe_cannot_leave():
    for key in (0, 159):
        with pytest.raises(ValueError, match="first and the last"):
            remove_keyframes(circling(160), [key])


def test_the_window_alone_finds_what_the_whole_graph_finds():
    whole, window = circling(200), circling(200)
    for graph in (whole, window):
        graph.edges.append(loop(graph, 136, 199, 0.004))
    start = whole.nodes.poses.copy()
    whole.optimise()
    window.optimise_window(100)
    moved = np.abs(whole.nodes.poses - start).max()
    assert moved > 0.5e-3
    np.testing.assert_allclose(window.relative(136, 199), whole.relative(136, 199), atol=0.1 * moved)
    np.testing.assert_allclose(window.nodes.heights[-20:], whole.nodes.heights[-20:], atol=2e-3)
    assert np.array_equal(window.nodes.poses[:100], start[:100])


def test_covariances_follow_appended_keyframes_without_a_new_factorisation():
    graph = circling(150)
    tracked = TrackedCovariance(graph, refresh=1000)
    tracked.of_newest()
    base = tracked._base
    rng = np.random.default_rng(9)
    for k in range(150, 160):
        edge = odometry(rng, k - 1, k)
        graph.edges.append(edge)
        pose = geometry.se2_compose(graph.nodes[k - 1], parts_at(edge, graph.bias))
        graph.nodes.append(k, pose, 0.0, np.eye(3), 0.25 * k)
        tracked.follow(edge, graph.bias)
    scale = np.abs(graph.covariance([159])).max()
    np.testing.assert_allclose(tracked.of_newest(), graph.covariance([159]), atol=0.01 * scale)
    Ad = geometry.se2_adjoint(geometry.se2_inverse(graph.relative(97, 159)))
    A = np.concatenate([-Ad, np.eye(3)], axis=1)
    expected = A @ graph.covariance([97, 159]) @ A.T
    np.testing.assert_allclose(tracked.relative(97), expected, atol=0.01 * np.abs(expected).max())
    assert tracked._base is base


def test_closures_that_covariances_do_not_know_yet_leave_them_too_large():
    graph = circling(150)
    tracked = TrackedCovariance(graph, refresh=1000)
    before = tracked.of_newest()
    graph.edges.append(loop(graph, 86, 149, 0.0))
    tracked.closed(1, np.zeros((3, 3)), sigma=0.025)
    assert np.linalg.eigvalsh(tracked.of_newest() - graph.covariance([149]))[0] >= -1e-12
    np.testing.assert_array_equal(tracked.of_newest(), before)
    tracked.closed(1, np.diag([0.03**2, 0.0, 0.0]), sigma=0.025)
    np.testing.assert_allclose(tracked.of_newest(), graph.covariance([149]), err_msg="they told much: they count")


def test_covariances_are_made_anew_one_keyframe_after_others_went():
    graph = circling(150)
    tracked = TrackedCovariance(graph, refresh=1000)
    before = tracked.of_newest()
    remove_keyframes(graph, graph.nodes.ids[20:60:4].tolist())
    tracked.shrunk()
    np.testing.assert_array_equal(tracked.of_newest(), before)
    edge = odometry(np.random.default_rng(9), 149, 150)
    graph.edges.append(edge)
    graph.nodes.append(150, geometry.se2_compose(graph.nodes[149], parts_at(edge, graph.bias)), 0.0, np.eye(3), 37.5)
    tracked.follow(edge, graph.bias)
    np.testing.assert_allclose(tracked.of_newest(), graph.covariance([150]))


def test_merging_takes_the_farthest_first_and_never_beyond_the_extent():
    graph = circling(120)
    robot = graph.nodes.poses[-1, :2]
    chosen = mergeable(graph, {}, 0.3, 30, robot)
    assert chosen
    assert all(0 < k < 90 for k in chosen)
    assert min(abs(a - b) for a in chosen for b in chosen if a != b) >= 2
    distance = [float(np.hypot(*(graph.nodes[k][:2] - robot))) for k in chosen]
    assert distance[0] == pytest.approx(max(np.hypot(*(graph.nodes.poses[1:90, :2] - robot).T)), abs=0.1)
    assert not mergeable(graph, {}, 0.2, 30, robot)
    spans = dict.fromkeys(range(120), 0.25)
    assert not mergeable(graph, spans, 0.3, 30, robot)


def test_ground_covers_touches_near_it_and_no_others():
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(0, 1, (4000, 2)), np.zeros(4000)])
    inside, outside = rng.uniform(0.1, 0.9, (500, 3)), rng.uniform(1.2, 2.0, (500, 3))
    assert covered_share(inside, ground, 0.04) > 0.99
    assert covered_share(outside, ground, 0.04) == 0.0
    assert covered_share(np.concatenate([inside, outside]), ground, 0.04) == pytest.approx(0.5, abs=0.01)
    assert covered_share(inside, np.zeros((0, 3)), 0.04) == 0.0


class TestPatchMemory:
    def test_paged_touches_come_back_as_they_were(self):
        rng = np.random.default_rng(1)
        sides = {k: rng.uniform(-0.6, 0.6, (20 * (k % 2), 3)) for k in range(50)}
        patches = {k: Patch(rng.uniform(-0.6, 0.6, (100, 3)), 0.25 * k, walls) for k, walls in sides.items()}
        memory = PatchMemory(1000, SqlitePages())
        for k, patch in patches.items():
            memory[k] = patch
            assert memory.points_in_memory <= 1000
        for k in rng.permutation(50).tolist():
            np.testing.assert_allclose(memory[k].points, patches[k].points, atol=1e-7)
            np.testing.assert_allclose(memory[k].walls, patches[k].walls, atol=1e-7)
            assert memory[k].travelled == patches[k].travelled
            assert memory.points_in_memory <= 1000
        assert memory.fetched >= 40
        assert list(memory) == list(range(50))

    def test_what_was_taken_out_or_replaced_never_comes_back(self):
        memory = PatchMemory(300, SqlitePages())
        for k in range(10):
            memory[k] = Patch(np.full((100, 3), float(k)), 0.0)
        memory.pop(2)
        memory[3] = Patch(np.full((50, 3), -1.0), 0.0)
        for k in range(4, 10):
            memory[k]
        assert 2 not in memory
        with pytest.raises(KeyError):
            memory[2]
        np.testing.assert_array_equal(memory[3].points, np.full((50, 3), -1.0))

    def test_a_failing_disk_costs_memory_and_no_touches(self):
        class Full(SqlitePages):
            def write(self, _key, _points):
                raise OSError("No space left on device")

        memory = PatchMemory(300, Full())
        for k in range(10):
            memory[k] = Patch(np.full((100, 3), float(k)), 0.0)
        assert all((memory[k].points == k).all() for k in range(10))
        assert "No space" in memory.fault


def small_bounds(**changes) -> RobustSlamSection:
    values = {
        "local_window": 30, "small_map": 30, "max_keyframes": 80, "max_points_in_memory": 20_000, "full_every": 50,
        **changes,
    }  # fmt: skip
    return RobustSlamSection(bounds=BoundedMapSection(**values))


def rounds(count: int):
    """Keyframes of a robot that goes round and round."""
    return drive("rounds", 4, count)


def test_a_capped_graph_stays_within_its_cap_and_as_accurate():
    capped = list(run("rounds", 4, 220, 110, small_bounds()))
    free = list(run("rounds", 4, 220, 110, small_bounds(max_keyframes=100_000, max_points_in_memory=10**8)))
    assert all(block.nodes <= 80 for block in capped)
    assert free[-1].nodes == 220
    assert np.mean(capped[-1].errors_m) <= np.mean(free[-1].errors_m) + 0.01
    assert np.mean(capped[-1].errors_m) < 0.06
    assert np.median(capped[-1].backend_ms) <= 3.0 * np.median(capped[0].backend_ms) + 10.0
    assert capped[-1].points < 0.8 * free[-1].points


def test_removed_keyframes_vanish_from_map_graph_and_stream():
    backend, whole = RobustBackend(small_bounds(), SqlitePages()), KeyframeMap(0.01)
    encoder, decoder = MapStreamEncoder(7), MapStreamDecoder()
    removed: set[int] = set()
    bare: set[int] = set()
    again: set[int] = set()
    walls = set(range(60, 180, 7))
    for keyframe, _ in rounds(180):
        if keyframe.id in walls:
            floor = np.ones(len(keyframe.points), dtype=np.bool_)
            floor[0] = False
            keyframe = replace(keyframe, floor=floor)
        result = backend.process(keyframe)
        again |= {key for key in result.bare if key < keyframe.id - 40}
        whole.take(result)
        removed |= set(result.removed)
        bare |= set(result.bare)
        vectors = geometry.to_vector7(whole.poses)
        for message in encoder.update(whole.version, whole.keyframes, vectors):
            decoder.feed(message)
    assert len(removed) > 80
    assert bare
    # In a full map later passes cover what was kept at first; touches of walls nothing covers.
    assert again
    assert not bare & walls
    ids = [k.id for k in whole.keyframes]
    assert not set(ids) & removed
    assert ids == sorted(ids)
    assert len(whole.poses) == len(ids) <= 80
    graph = json.loads(graph_json(whole, 0))
    assert [k["id"] for k in graph["keyframes"]] == ids
    assert {e["i"] for e in graph["edges"]} | {e["j"] for e in graph["edges"]} <= set(ids)
    chain = sorted((e["i"], e["j"]) for e in graph["edges"] if e["kind"] == "odometry")
    assert chain == list(pairwise(ids))
    assert decoder.state is not None
    assert decoder.state.digest() == encoder.state.digest()
    assert sorted(decoder.state.keyframes) == ids
    for keyframe in whole.keyframes:
        assert len(decoder.state.keyframes[keyframe.id].points) <= len(keyframe.points)
        assert bool(len(keyframe.points)) == bool(len(decoder.state.keyframes[keyframe.id].points))
        assert bool(len(keyframe.points)) == (keyframe.id not in bare)


def test_a_short_drive_is_as_accurate_with_a_tiny_cap():
    """On a real recording's keyframes: the end of the drive lies where it lies without bounds, to 4 cm."""
    inputs = prepare(RECORDING, None)
    ends = []
    for bounds in ({}, {"max_keyframes": 50, "small_map": 20, "local_window": 20, "max_points_in_memory": 10_000}):
        keys = {"slam.method": "robust", "estimation.source": "fused"}
        keys |= {f"slam.robust.bounds.{name}": value for name, value in bounds.items()}
        result = replay(replace(inputs, configuration=overridden(inputs.configuration, keys, "test")), lambda _: None)
        ends.append(result.keyframe_map.poses[-1])
        assert len(result.keyframe_map.keyframes) <= bounds.get("max_keyframes", 1000)
    assert np.hypot(*(ends[0] - ends[1])[:2, 3]) < 0.04


def test_small_maps_are_solved_whole_and_keep_everything():
    """Bounds that are not reached change nothing, bit for bit."""
    far = RobustSlamSection(bounds=BoundedMapSection(max_keyframes=100_000, local_window=99_999))
    near = RobustSlamSection(bounds=BoundedMapSection(max_keyframes=70, local_window=70, full_every=1, refresh=1))
    one, other = RobustBackend(far), RobustBackend(near, SqlitePages())
    for keyframe, _ in rounds(70):
        a, b = one.process(keyframe), other.process(keyframe)
    np.testing.assert_array_equal(a.poses, b.poses)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert sum(edge.kind == "loop" for edge in a.edges) > 3
