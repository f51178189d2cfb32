"""Receivers that were away get what they missed; ground is told once; the reference reader agrees with ours."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robominer_slam.publishing import map_changes
from robominer_slam.publishing.map_stream import MapStreamDecoder, MapStreamEncoder
from robominer_slam.publishing.point_bytes import PointBytesError, ordered, pack_points, unpack_points
from tests.test_map_stream import MAP_ID, STAMP, Source, World, assert_same

CELL = 0.03


def reference_reader():
    path = Path(__file__).resolve().parents[1] / "docs" / "map_stream_reader.py"
    assert len(path.read_text().splitlines()) < 100
    spec = importlib.util.spec_from_file_location("map_stream_reader", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.MapReader()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(0, 12), st.integers(0, 12))
def test_a_receiver_that_was_away_gets_what_it_missed_and_no_more(seed: int, before: int, away: int) -> None:
    world, encoder, decoder = World(seed), MapStreamEncoder(MAP_ID, CELL), MapStreamDecoder()
    for _ in range(before):
        world.step()
        for message in world.update(encoder):
            decoder.feed(message)
    for _ in range(away):
        world.step()
        world.update(encoder)
    if not before:
        assert decoder.copy == {}
        decoder.feed(b"".join(encoder.snapshot()))
    else:
        copy = decoder.copy
        changes = encoder.changes(copy["map_id"], copy["epoch"], copy["since"])
        assert changes is not None
        if away:
            decoder.feed(b"".join(changes))
    if before or away:
        assert_same(decoder.state, encoder.state)
    assert decoder.counters["bad_content"] == 0


def test_a_copy_of_another_stream_or_of_too_long_ago_needs_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_changes, "MAX_REMEMBERED_GONE", 2)
    encoder, decoder = MapStreamEncoder(MAP_ID), MapStreamDecoder()
    sources = [Source(k, STAMP, np.zeros((1, 3))) for k in range(8)]
    pose = np.array([0, 0, 0, 0, 0, 0, 1.0])
    for message in encoder.update(1, sources, np.tile(pose, (8, 1))):
        decoder.feed(message)
    map_id, epoch, since = decoder.copy.values()
    for version in range(2, 6):
        encoder.update(version, sources[version - 1 :], np.tile(pose, (9 - version, 1)))
    assert encoder.changes(map_id, epoch, since) is None
    assert encoder.changes(map_id, epoch, 3) is not None
    assert encoder.changes(map_id, epoch + 1, 3) is None
    assert encoder.changes(map_id + 1, epoch, 3) is None
    assert encoder.changes(map_id, epoch, 6) is None


def test_a_loop_closure_is_sent_as_poses() -> None:
    rng, encoder = np.random.default_rng(0), MapStreamEncoder(MAP_ID, CELL)
    sources = [Source(k, STAMP + k, rng.uniform(-0.3, 0.3, (300, 3))) for k in range(100)]
    poses = np.column_stack([np.arange(100.0), np.zeros((100, 5)), np.ones(100)])
    whole = sum(map(len, encoder.update(1, sources, poses)))
    poses[:, 1] += np.linspace(0.0, 0.5, 100)
    assert sum(map(len, encoder.update(2, sources, poses))) < 0.05 * whole
    assert all(len(frame.points) > 200 for frame in encoder.state.keyframes.values())


def test_ground_is_told_once_however_often_it_is_touched() -> None:
    rng, encoder = np.random.default_rng(1), MapStreamEncoder(MAP_ID, CELL)
    ground = np.column_stack([rng.uniform(-0.2, 0.2, (4000, 2)), np.zeros(4000)])
    pose = np.array([0, 0, 0.001, 0, 0, 0, 1.0])
    sources = [Source(k, STAMP + k, ground + rng.normal(0, 1e-4, ground.shape)) for k in range(4)]
    for n in range(1, 5):
        encoder.update(n, sources[:n], np.tile(pose, (n, 1)))
    told = [len(encoder.state.keyframes[k].points) for k in range(4)]
    cells = (0.4 / CELL) ** 2
    assert cells <= told[0] <= 1.3 * cells
    assert sum(told[1:]) < 0.1 * cells
    # Where the one that told it goes, and its touches come to another, that one tells it.
    merged = Source(1, STAMP + 1, np.concatenate([sources[1].points, sources[0].points]))
    encoder.update(5, [merged, *sources[2:]], np.tile(pose, (3, 1)))
    assert sum(len(frame.points) for frame in encoder.state.keyframes.values()) >= cells


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_the_reference_reader_holds_the_same(seed: int) -> None:
    world, encoder, reader = World(seed), MapStreamEncoder(MAP_ID, CELL), reference_reader()
    for k in range(8):
        world.step()
        messages = world.update(encoder)
        if k == 3:
            continue  # missed
        for message in messages:
            reader.feed(message)
        if reader.wanting:
            reader.feed(b"".join(encoder.snapshot()))
        assert not reader.wanting
        expected = {
            key: (frame.stamp_ns, frame.pose, [tuple(point) for point in frame.points.tolist()])
            for key, frame in encoder.state.keyframes.items()
        }
        assert reader.keyframes == expected
        assert reader.version == encoder.state.version


int16 = st.integers(-(2**15), 2**15 - 1)


@given(st.lists(st.tuples(int16, int16, int16), max_size=60), st.binary(max_size=5))
def test_points_come_back_as_they_were(rows: list[tuple[int, int, int]], behind: bytes) -> None:
    points = np.array(rows, dtype=np.int16).reshape(-1, 3)
    packed = b"x" + pack_points(points) + behind
    found, at = unpack_points(packed, 1, len(points))
    np.testing.assert_array_equal(found, points)
    assert at == len(packed) - len(behind)
    assert {tuple(row) for row in ordered(points).tolist()} == set(rows)


@given(st.binary(max_size=40), st.integers(0, 20))
def test_other_bytes_are_points_or_refused(data: bytes, count: int) -> None:
    try:
        found, at = unpack_points(data, 0, count)
    except PointBytesError:
        return
    assert found.shape == (count, 3)
    assert at <= len(data)
