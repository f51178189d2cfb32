"""The map stream: receivers hold what the sender holds, whatever gets lost, comes late or is damaged."""

from __future__ import annotations

import hashlib
import struct
import zlib
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robominer_slam.publishing.map_records import (
    FORMAT,
    KeyframeRecord,
    PointsRecord,
    PoseRecord,
    RemoveRecord,
    pack_bodies,
    unpack_messages,
    unpack_records,
)
from robominer_slam.publishing.map_stream import (
    MAX_MESSAGE_BYTES,
    MapState,
    MapStreamDecoder,
    MapStreamEncoder,
)

MAP_ID = 0x1234_5678_9ABC_DEF0
STAMP = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Source:
    id: int
    stamp_ns: int
    points: np.ndarray


class World:
    """A map that changes at random: keyframes come, go and move."""

    def __init__(self, seed: int, points: int = 60) -> None:
        self.rng = np.random.default_rng(seed)
        self.points = points
        self.keyframes: list[Source] = []
        self.poses: list[np.ndarray] = []
        self.version = 0
        #: Ids are never given twice.
        self.given = 0

    def step(self) -> None:
        self.version += int(self.rng.integers(1, 3))
        kind = self.rng.integers(5)
        if kind == 4 and self.keyframes:
            gone = int(self.rng.integers(len(self.keyframes)))
            del self.keyframes[gone], self.poses[gone]
        elif kind == 3:
            self.poses = [self._moved(pose) for pose in self.poses]
        else:
            number, self.given = self.given, self.given + 1
            count = int(self.rng.integers(0, self.points))
            cloud = self.rng.normal(0.0, 0.4, (count, 3))
            self.keyframes.append(Source(number, STAMP + number * 10**9, cloud))
            q = self.rng.normal(size=4)
            self.poses.append(np.concatenate([self.rng.normal(0, 30, 3), q / np.linalg.norm(q)]))

    def _moved(self, pose: np.ndarray) -> np.ndarray:
        if self.rng.random() < 0.5:
            return pose
        turned = Rotation.from_quat(pose[3:]) * Rotation.from_rotvec(self.rng.normal(0, 0.02, 3))
        return np.concatenate([pose[:3] + self.rng.normal(0, 0.05, 3), turned.as_quat()])

    def update(self, encoder: MapStreamEncoder) -> list[bytes]:
        return encoder.update(self.version, self.keyframes, np.array(self.poses).reshape(-1, 7))

    def cloud(self) -> np.ndarray:
        parts = [
            Rotation.from_quat(pose[3:]).apply(source.points) + pose[:3]
            for source, pose in zip(self.keyframes, self.poses, strict=True)
            if len(source.points)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3))


def assert_same(found: MapState | None, expected: MapState) -> None:
    assert found is not None
    assert (found.map_id, found.version) == (expected.map_id, expected.version)
    assert found.keyframes.keys() == expected.keyframes.keys()
    for key, keyframe in expected.keyframes.items():
        other = found.keyframes[key]
        assert (other.stamp_ns, other.pose) == (keyframe.stamp_ns, keyframe.pose)
        np.testing.assert_array_equal(other.points, keyframe.points)
    assert found.digest() == expected.digest()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 12))
def test_a_receiver_that_gets_everything_holds_the_senders_state(seed: int, steps: int) -> None:
    world, encoder, decoder = World(seed), MapStreamEncoder(MAP_ID), MapStreamDecoder()
    for _ in range(steps):
        world.step()
        for message in world.update(encoder):
            assert len(message) <= MAX_MESSAGE_BYTES
            decoder.feed(message)
        assert_same(decoder.state, encoder.state)
        assert not decoder.needs_snapshot
    assert decoder.counters == {"updates": steps}


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_losses_are_noticed_and_a_snapshot_mends_them(seed: int) -> None:
    world, encoder, decoder = World(seed, points=2000), MapStreamEncoder(MAP_ID), MapStreamDecoder()
    rng = np.random.default_rng(seed)
    for _ in range(8):
        world.step()
        messages = world.update(encoder)
        kept = [message for message in messages if rng.random() > 0.3]
        rng.shuffle(kept)
        for message in kept:
            decoder.feed(message)
        if len(kept) == len(messages) and decoder.state is not None and decoder.state.version != world.version:
            assert decoder.needs_snapshot
        if decoder.needs_snapshot:
            decoder.feed(b"".join(encoder.snapshot()))
            assert_same(decoder.state, encoder.state)
            assert not decoder.needs_snapshot


def test_updates_that_overtake_a_snapshot_are_applied_after_it() -> None:
    world, encoder = World(3), MapStreamEncoder(MAP_ID)
    updates = []
    snapshot: list[bytes] = []
    for k in range(9):
        world.step()
        updates.append(world.update(encoder))
        if k == 4:
            snapshot = encoder.snapshot()
    late = MapStreamDecoder()
    for messages in updates[5:]:
        for message in messages:
            assert not late.feed(message)
    assert late.needs_snapshot
    assert late.feed(b"".join(snapshot))
    assert_same(late.state, encoder.state)
    assert not late.needs_snapshot
    # What is known already changes nothing.
    assert not late.feed(b"".join(snapshot))
    assert not late.feed(updates[6][0])
    assert late.counters["stale"] >= 2


def test_updates_that_come_in_the_wrong_order_are_applied_in_the_right_one() -> None:
    world, encoder, decoder = World(5), MapStreamEncoder(MAP_ID), MapStreamDecoder()
    updates = []
    for _ in range(6):
        world.step()
        updates.append(world.update(encoder))
    for k in (0, 3, 2, 1, 5):
        for message in updates[k]:
            decoder.feed(message)
    assert decoder.needs_snapshot
    for message in updates[4]:
        decoder.feed(message)
    assert_same(decoder.state, encoder.state)
    assert not decoder.needs_snapshot
    assert decoder.counters == {"updates": 6}


def test_the_cloud_is_where_the_map_has_it() -> None:
    world, encoder = World(11), MapStreamEncoder(MAP_ID)
    for _ in range(10):
        world.step()
        world.update(encoder)
    found, expected = encoder.state.cloud(), world.cloud()
    assert len(found) == len(expected) > 50
    # Poses may lag by the tolerances: 2 mm and 1 mrad at under 2.5 m, and the rounding of both; points by 2.5 mm.
    distance = np.linalg.norm(found[:, None] - expected[None], axis=2).min(axis=1)
    assert distance.max() < 0.013


def test_small_corrections_are_not_sent_but_never_add_up() -> None:
    encoder = MapStreamEncoder(MAP_ID)
    source = Source(0, STAMP, np.zeros((1, 3)))
    pose = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    encoder.update(1, [source], pose[None])
    sent = 0
    for version in range(2, 102):
        pose[0] += 0.0005
        [message] = encoder.update(version, [source], pose[None])
        [(_, body)] = unpack_messages(message)
        sent += len(unpack_records(body))
        assert abs(encoder.state.keyframes[0].vector7()[0] - pose[0]) <= 0.0026
    assert 20 <= sent <= 30


def test_a_restarted_sender_and_a_new_map_need_no_snapshot() -> None:
    decoder = MapStreamDecoder()
    streams = [MapStreamEncoder(MAP_ID), MapStreamEncoder(MAP_ID), MapStreamEncoder(MAP_ID + 1)]
    first = []
    for k, encoder in enumerate(streams):
        world = World(k)
        # The restarted sender begins at a lower version than the one before it had reached.
        for _ in range(6 - 2 * k):
            world.step()
            for message in world.update(encoder):
                first.append(message)
                decoder.feed(message)
        assert_same(decoder.state, encoder.state)
        assert not decoder.needs_snapshot
    # A late copy of the first stream's first update, which fits any empty map, leads nowhere.
    assert not decoder.feed(first[0])
    assert_same(decoder.state, streams[-1].state)


def test_the_bytes_lie_as_documented() -> None:
    """Read with nothing but docs/map-stream.md."""
    encoder = MapStreamEncoder(MAP_ID)
    cloud = np.array([[0.010, -0.015, 0.020], [0.005, 0.025, -0.001], [1.005, 0.025, 0.0]])
    [message] = encoder.update(9, [Source(5, STAMP, cloud)], np.array([[1.5, -2.0, 0.25, 0, 0, 0.6, 0.8]]))
    magic, form, kind, size, map_id, _, base, version, part, parts, digest = struct.unpack_from(
        "<4sBBHQIIIHH8s", message
    )
    assert (magic, form, kind, map_id, base, version, part, parts) == (b"RMAP", 2, 1, MAP_ID, 0, 9, 0, 1)
    assert len(message) == 40 + size
    body = zlib.decompress(message[40:])
    pose = struct.pack("<3i4h", 1500, -2000, 250, 0, 0, round(0.6 * 32767), round(0.8 * 32767))
    keyframe = struct.pack("<BIqI", 1, 5, STAMP, 3) + pose
    # The strip of y = -3 comes before that of y = 5. Differences of x: 2, -1, 200; of y: -3, 8, 0; of z: 4, -4, 0.
    steps = bytes([4, 1, 0x90, 0x03, 5, 16, 0, 8, 7, 0])
    assert body == keyframe + struct.pack("<BIH", 2, 5, 3) + steps
    rows = hashlib.blake2b(struct.pack("<9h", 2, -3, 4, 1, 5, 0, 201, 5, 0), digest_size=16).digest()
    state = struct.pack("<QII", MAP_ID, 9, 1) + struct.pack("<IqI", 5, STAMP, 3) + pose + rows
    assert digest == hashlib.blake2b(state, digest_size=8).digest()


def test_a_snapshot_of_the_empty_map_is_one_message() -> None:
    encoder, decoder = MapStreamEncoder(MAP_ID), MapStreamDecoder()
    [message] = encoder.snapshot()
    assert decoder.feed(message)
    assert_same(decoder.state, MapState(MAP_ID))


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**31), st.data())
def test_damaged_messages_never_raise_and_never_change_the_map_wrongly(seed: int, data: st.DataObject) -> None:
    world, encoder, decoder = World(seed), MapStreamEncoder(MAP_ID), MapStreamDecoder()
    for _ in range(3):
        world.step()
        for message in world.update(encoder):
            decoder.feed(message)
    before = decoder.state
    world.step()
    [message] = world.update(encoder)
    position = data.draw(st.integers(0, len(message) - 1))
    bit = data.draw(st.integers(0, 7))
    damaged = bytearray(message)
    damaged[position] ^= 1 << bit
    if decoder.feed(bytes(damaged)):
        # Where the damage did no harm to the state: the epoch is in no digest, zlib has unused bits.
        assert_same(decoder.state, encoder.state)
    else:
        assert decoder.state is before


@given(st.binary(max_size=300))
def test_garbage_is_counted(data: bytes) -> None:
    decoder = MapStreamDecoder()
    for junk in (data, b"RMAP\x01" + data):
        assert not decoder.feed(junk)
    assert decoder.state is None


def test_messages_of_another_format_are_counted_and_dropped() -> None:
    [message] = MapStreamEncoder(MAP_ID).snapshot()
    other = bytearray(message)
    other[4] = FORMAT + 1
    decoder = MapStreamDecoder()
    assert not decoder.feed(bytes(other))
    assert decoder.counters == {"bad_message": 1}


int16 = st.integers(-(2**15), 2**15 - 1)
int32 = st.integers(-(2**31), 2**31 - 1)
uint32 = st.integers(0, 2**32 - 1)
poses = st.tuples(int32, int32, int32, int16, int16, int16, st.integers(1, 32767))
points = st.lists(st.tuples(int16, int16, int16), max_size=40).map(
    lambda rows: np.array(sorted(rows), dtype=np.int16).reshape(-1, 3)
)
records = st.one_of(
    st.builds(KeyframeRecord, uint32, st.integers(-(2**63), 2**63 - 1), poses, uint32),
    st.builds(PointsRecord, uint32, points.filter(len)),
    st.builds(PoseRecord, uint32, poses),
    st.builds(RemoveRecord, uint32),
)


@given(st.lists(records, max_size=30))
def test_records_come_back_as_they_were(content: list[object]) -> None:
    found = [record for body in pack_bodies(content) for record in unpack_records(zlib.decompress(body))]
    assert [type(record) for record in found] == [type(record) for record in content]
    for got, sent in zip(found, content, strict=True):
        for a, b in zip(got, sent, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_large_keyframe_is_spread_over_messages_that_are_well_filled() -> None:
    encoder, decoder = MapStreamEncoder(MAP_ID), MapStreamDecoder()
    cloud = np.random.default_rng(0).uniform(-0.5, 0.5, (20_000, 3))
    messages = encoder.update(1, [Source(7, STAMP, cloud)], np.array([[0, 0, 0, 0, 0, 0, 1.0]]))
    for message in messages:
        assert len(message) <= MAX_MESSAGE_BYTES
        decoder.feed(message)
    # No piece of a keyframe is longer than 2.4 KB, and of such points 0.9 KB.
    assert min(len(message) for message in messages[:-1]) > MAX_MESSAGE_BYTES - 900
    assert_same(decoder.state, encoder.state)


def test_points_that_the_format_cannot_carry_are_left_out_and_counted() -> None:
    encoder = MapStreamEncoder(MAP_ID)
    cloud = np.array([[0.001, 0.0, 0.0], [np.nan, 0, 0], [40.0, 0, 0], [0.0012, 0.0004, 0.0], [-32.0, 0, 0]])
    encoder.update(1, [Source(0, STAMP, cloud)], np.array([[0, 0, 0, 0, 0, 0, -1.0]]), clock_offset_ns=5)
    keyframe = encoder.state.keyframes[0]
    assert keyframe.points.tolist() == [[-6400, 0, 0], [0, 0, 0]]
    assert keyframe.pose == (0, 0, 0, 0, 0, 0, 32767)
    assert keyframe.stamp_ns == STAMP + 5
    assert encoder.points_left_out == 2


def test_impossible_updates_are_refused() -> None:
    encoder = MapStreamEncoder(MAP_ID)
    encoder.update(3, [], np.zeros((0, 7)))
    with pytest.raises(ValueError, match="version 3 after 3"):
        encoder.update(3, [], np.zeros((0, 7)))
    with pytest.raises(ValueError, match="not finite"):
        encoder.update(4, [Source(0, STAMP, np.zeros((1, 3)))], np.full((1, 7), np.nan))
    # The refused update changed nothing.
    assert (encoder.state.version, encoder.state.keyframes) == (3, {})
