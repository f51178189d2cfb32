"""The receiver of the map without a network: what it asks and when, and that losses of every kind are made good."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robominer_slam.publishing.bus_messages import Query, QueryRefusedError, Received
from robominer_slam.publishing.map_answers import KEEP_S, MAX_KEPT_BYTES, MapAnswers
from robominer_slam.publishing.map_publisher import MapPublisher, update_payloads
from robominer_slam.publishing.map_receiver import GRACE_S, MIN_PORTION, MapReceiver
from robominer_slam.publishing.map_records import unpack_messages
from robominer_slam.publishing.map_stream import MAX_MESSAGE_BYTES, MapStreamEncoder
from tests.test_map_stream import MAP_ID, World


class Wire:
    """Robot, link and clock in one: what is lost is up to `lost`."""

    def __init__(self, seed: int, points: int = 60, cell: float | None = 0.03) -> None:
        self.now = 0.0
        self.world = World(seed, points)
        self.publisher = MapPublisher(self, MAP_ID, cell)
        self.receiver = MapReceiver(self, clock=lambda: self.now)
        self.deliver: Callable[[Received], None] = self.receiver.take
        self.lost: Callable[[], bool] = lambda: False
        self.asked: list[Mapping[str, str]] = []
        self._pending: list[tuple[Mapping[str, str], Callable[[Received], None], Callable[[], None]]] = []

    def put(self, key: str, payload: bytes) -> None:
        if not self.lost():
            self.deliver(Received(key, payload, "", None))

    def subscriber(self, key: str, callback: Callable[[Received], None]) -> None:
        raise AssertionError(f"{key}: {callback} is not needed, messages are handed over here")

    def ask(
        self,
        key: str,
        parameters: Mapping[str, str],
        on_reply: Callable[[Received], None],
        on_end: Callable[[], None],
        timeout_s: float,
    ) -> None:
        assert key == "map/snapshot"
        assert not self._pending, "one query at a time"
        assert 1.0 < timeout_s < 20.0
        self.asked.append(parameters)
        self._pending.append((parameters, on_reply, on_end))

    def step(self) -> None:
        self.world.step()
        self.world.update(self.publisher)

    def answer(self) -> bool:
        """Answer the query under way; False if there is none."""
        if not self._pending:
            return False
        parameters, on_reply, on_end = self._pending.pop()
        if not self.lost():
            for reply in self.publisher.answer(Query("map/snapshot", parameters, b"")):
                if not self.lost():
                    on_reply(Received("map/snapshot", reply.payload, "", None))
        on_end()
        return True

    def tick(self, seconds: float = 0.2) -> None:
        """Some time passes; telemetry comes."""
        self.now += seconds
        if not self.lost():
            self.receiver.heard(self.publisher.state.version, self.publisher.digest)
        self.receiver.tick()

    def settle(self, ticks: int = 400) -> None:
        for _ in range(ticks):
            self.tick()
            self.answer()
            if self.receiver.synchronised:
                return
        raise AssertionError(f"not synchronised: {dict(self.receiver.counters)}")


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.0, 0.9))
def test_whatever_is_lost_the_copy_becomes_the_robots_map(seed: int, loss: float) -> None:
    wire, rng = Wire(seed), np.random.default_rng(seed)
    wire.lost = lambda: bool(rng.random() < loss)
    for _ in range(40):
        wire.step()
        wire.tick()
        if rng.random() < 0.7:
            wire.answer()
    wire.lost = lambda: False
    wire.settle()
    assert wire.receiver.digest == wire.publisher.digest


def test_who_gets_everything_asks_nothing() -> None:
    wire = Wire(1)
    for _ in range(30):
        wire.step()
        wire.tick()
        assert wire.receiver.synchronised
        assert wire.receiver.behind == 0
    assert wire.asked == []


def test_telemetry_that_overtakes_an_update_is_no_reason_to_ask() -> None:
    wire = Wire(2)
    wire.step()
    wire.tick()
    late: list[Received] = []
    wire.deliver, take = late.append, wire.deliver
    wire.step()
    wire.tick()
    assert not wire.receiver.synchronised
    wire.tick(GRACE_S / 2)
    assert wire.asked == []
    for received in late:
        take(received)
    wire.tick(GRACE_S)
    assert wire.receiver.synchronised
    assert wire.asked == []


def test_a_lost_last_update_is_noticed_by_the_version_alone() -> None:
    wire = Wire(3)
    for _ in range(5):
        wire.step()
    wire.lost = lambda: True
    wire.step()
    wire.lost = lambda: False
    wire.tick()
    assert (wire.receiver.behind or 0) > 0
    wire.settle()
    assert [set(asked) for asked in wire.asked] == [{"map_id", "epoch", "since", "limit"}]


def test_a_robot_that_was_started_anew_is_followed() -> None:
    wire = Wire(4)
    for _ in range(5):
        wire.step()
    wire.settle()
    before = wire.receiver.digest
    wire.publisher = MapPublisher(wire, MAP_ID + 1, 0.03)
    wire.lost = lambda: True
    # The same version of another map: only the digest tells.
    wire.world.update(wire.publisher)
    wire.lost = lambda: False
    wire.tick()
    assert wire.receiver.behind == 0
    assert not wire.receiver.synchronised
    wire.settle()
    assert wire.receiver.digest == wire.publisher.digest != before


def test_queries_without_an_answer_come_less_and_less_often_until_something_is_heard() -> None:
    wire = Wire(5)
    wire.lost = lambda: True
    times: list[float] = []
    while wire.now < 60.0:
        asked = len(wire.asked)
        wire.tick()
        if len(wire.asked) > asked:
            times.append(wire.now)
        wire.answer()
    gaps = np.diff(times)
    assert len(times) < 14
    assert gaps[-1] > 7.0
    wire.step()
    wire.lost = lambda: False
    wire.tick()
    assert wire.answer(), "the first message ends the pause"


def test_a_query_whose_end_never_comes_does_not_hold_the_receiver_up() -> None:
    wire = Wire(6)
    wire.step()
    wire.receiver = MapReceiver(wire, clock=lambda: wire.now)
    wire.tick()
    assert len(wire.asked) == 1
    wire._pending.clear()
    wire.tick(20.0)
    wire.settle()


def test_portions_grow_where_the_link_is_fast_and_shrink_where_it_is_slow() -> None:
    wire = Wire(7, points=4000, cell=None)
    wire.lost = lambda: True
    for _ in range(150):
        wire.step()
    wire.lost = lambda: False
    wire.tick()
    while len(wire.asked) < 5:
        assert wire.answer()
    assert [int(asked["limit"]) for asked in wire.asked] == [MIN_PORTION * 2**k for k in range(5)]
    for _ in range(4):
        wire.now += 1.0
        assert wire.answer()
    assert int(wire.asked[-1]["limit"]) == MIN_PORTION
    assert {asked.get("answer") for asked in wire.asked[1:]} == {wire.asked[1]["answer"]}
    wire.settle()


@given(st.integers(0, 2**31), st.integers(1, 30_000))
@settings(max_examples=10, deadline=None)
def test_portions_keep_to_their_limit_and_add_up(seed: int, limit: int) -> None:
    world, stream = World(seed, 2000), MapStreamEncoder(MAP_ID)
    for _ in range(15):
        world.step()
        world.update(stream)
    answers, whole = MapAnswers(stream), stream.snapshot()
    found: list[bytes] = []
    while len(found) < len(whole):
        name = {} if not found else {"answer": answers_name(whole[0]), "part": str(len(found))}
        portion = answers.answer({"limit": str(limit), **name})
        assert len(portion) == 1 or sum(map(len, portion)) <= limit
        found += portion
        # The map goes on meanwhile; the answer does not.
        world.step()
        world.update(stream)
    assert found == whole


def test_answers_that_are_kept_are_bounded_and_forgotten() -> None:
    now = 0.0
    world, stream = World(9, 3000), MapStreamEncoder(MAP_ID)
    answers = MapAnswers(stream, lambda: now)
    for _ in range(40):
        world.step()
        world.update(stream)
        answers.answer({"limit": "1"})
    assert 1 < len(answers._kept) <= 4
    assert answers._bytes() <= MAX_KEPT_BYTES
    now = KEEP_S + 1.0
    answers.forget_old()
    assert not answers._kept


@pytest.mark.parametrize(
    "parameters", [{"since": "1"}, {"map_id": "1", "epoch": "2", "since": "-3"}, {"limit": "x"}, {"part": "one"}]
)
def test_parameters_that_mean_nothing_are_refused(parameters: dict[str, str]) -> None:
    with pytest.raises(QueryRefusedError, match="expected whole numbers"):
        Wire(0).publisher.answer(Query("map/snapshot", parameters, b""))


@given(st.lists(st.integers(49, MAX_MESSAGE_BYTES), min_size=1, max_size=60))
def test_payloads_of_large_updates_are_all_too_large_for_remote_links(sizes: list[int]) -> None:
    messages = [bytes([k]) * size for k, size in enumerate(sizes)]
    payloads = update_payloads(messages)
    assert b"".join(payloads) == b"".join(messages)
    if len(messages) > 1 and sum(sizes) > MAX_MESSAGE_BYTES:
        assert min(map(len, payloads)) > MAX_MESSAGE_BYTES
    assert max(map(len, payloads)) < 40_000


def answers_name(message: bytes) -> str:
    return next(unpack_messages(message))[0].name
