"""The bus over real Zenoh sessions on loopback: messages, answers, latched values, caches, errors of setting up."""

from __future__ import annotations

import queue
import socket
from collections.abc import Iterator

import pytest

from drivers.ros_messages import deserialize, header, serialize
from robominer_slam.publishing import keys
from robominer_slam.publishing.senders import LOCAL
from robominer_slam.publishing.zenoh_session import (
    Query,
    QueryError,
    QueryRefusedError,
    Received,
    Reply,
    ZenohBus,
    ZenohSettings,
    ZenohSetupError,
)
from robominer_slam.publishing.zenoh_settings import configuration

PREFIX = "robominer/test"
TIMEOUT = 10.0


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def robot(endpoint: str) -> Iterator[ZenohBus]:
    with ZenohBus(ZenohSettings(listen=(endpoint,)), PREFIX) as bus:
        yield bus


@pytest.fixture
def console(endpoint: str, robot: ZenohBus) -> Iterator[ZenohBus]:
    with ZenohBus(ZenohSettings(connect=(endpoint,), mode="client"), PREFIX) as bus:
        yield bus


class Inbox:
    """Messages as they come; waiting has an end."""

    def __init__(self) -> None:
        self._queue: queue.Queue[Received] = queue.Queue()
        self.put = self._queue.put

    def next(self) -> Received:
        return self._queue.get(timeout=TIMEOUT)

    def empty(self) -> bool:
        return self._queue.empty()


def publish_until_received(bus: ZenohBus, key: str, payload: bytes, inbox: Inbox) -> Received:
    """A subscription takes a moment to reach the publisher: repeat until the first one comes through."""
    for _ in range(200):
        bus.put(key, payload)
        try:
            return inbox._queue.get(timeout=0.05)
        except queue.Empty:
            continue
    raise AssertionError(f"nothing came on {key}")


@pytest.mark.parametrize("key", ["pose", "map/updates", "telemetry"])
def test_messages_arrive_with_key_encoding_and_payload(robot: ZenohBus, console: ZenohBus, key: str) -> None:
    inbox = Inbox()
    console.subscriber(key, inbox.put)
    payload = bytes(range(256)) * 8
    received = publish_until_received(robot, key, payload, inbox)
    assert received == Received(key, payload, keys.encoding_of(key), None)


def test_raw_messages_carry_their_ros_type_and_an_attachment(robot: ZenohBus, console: ZenohBus) -> None:
    inbox = Inbox()
    robot.subscriber("raw/**", inbox.put)
    payload = serialize(header(123, "imu"), "std_msgs/msg/Header")
    # From the client to the peer: its subscription is known as soon as the link stands, or shortly after.
    received = None
    for _ in range(200):
        console.put("raw/imu", payload, keys.cdr("std_msgs/msg/Header"), attachment=b"156")
        try:
            received = inbox._queue.get(timeout=0.05)
            break
        except queue.Empty:
            continue
    assert received is not None
    assert (received.key, received.schema, received.attachment) == ("raw/imu", "std_msgs/msg/Header", b"156")
    assert deserialize(received.payload, received.schema).frame_id == "imu"


def test_a_query_is_answered_with_its_parameters_and_payload(robot: ZenohBus, console: ZenohBus) -> None:
    asked: list[Query] = []

    def answer(query: Query) -> Reply:
        asked.append(query)
        return Reply(b'{"ok": true, "message": "saved"}')

    robot.queryable("cmd/save_map", answer)
    [reply] = ask(console, "cmd/save_map", {"name": "level 2", "id": "7"}, b"body")
    assert reply == Received("cmd/save_map", b'{"ok": true, "message": "saved"}', "application/json", None)
    assert asked[-1] == Query("cmd/save_map", {"name": "level 2", "id": "7"}, b"body", LOCAL)


def ask(
    bus: ZenohBus, key: str, parameters: dict[str, str] | None = None, payload: bytes | None = None
) -> list[Received]:
    """A queryable too takes a moment to become known."""
    for _ in range(200):
        try:
            return bus.get(key, parameters, payload, timeout_s=TIMEOUT)
        except QueryError as error:
            if "no answer" not in str(error):
                raise
    raise AssertionError(f"nobody answers {key}")


def test_several_answers_on_one_key_all_arrive_in_order(robot: ZenohBus, console: ZenohBus) -> None:
    parts = [bytes([k]) * 4000 for k in range(40)]
    robot.queryable("map/snapshot", lambda _: (Reply(part) for part in parts))
    replies = ask(console, "map/snapshot")
    assert [reply.payload for reply in replies] == parts
    assert {reply.encoding for reply in replies} == {keys.MAP_STREAM}


def test_a_query_with_wildcards_is_answered_on_the_declared_keys(robot: ZenohBus, console: ZenohBus) -> None:
    robot.queryable("map/graph", lambda _: Reply(b"{}"))
    robot.queryable("map/cloud", lambda _: Reply(b"cloud"))
    ask(console, "map/graph")
    found = {reply.key: reply.payload for reply in ask(console, "map/*")}
    assert found == {"map/graph": b"{}", "map/cloud": b"cloud"}


def test_refusals_and_failures_come_back_as_errors(
    robot: ZenohBus, console: ZenohBus, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_: Query) -> Reply:
        raise QueryRefusedError("the map is empty")

    def fail(_: Query) -> Reply:
        raise ValueError("broken inside")

    robot.queryable("cmd/refuse", refuse)
    robot.queryable("cmd/fail", fail)
    with pytest.raises(QueryError, match="the map is empty"):
        ask(console, "cmd/refuse")
    with pytest.raises(QueryError, match="internal error"):
        ask(console, "cmd/fail")
    assert "broken inside" in caplog.text


def test_a_query_that_nobody_answers_is_one_clear_error(console: ZenohBus) -> None:
    with pytest.raises(QueryError, match="robominer/test/map/grid: no answer; is the"):
        console.get("map/grid", timeout_s=0.5)


def test_a_callback_that_fails_is_logged_and_the_next_message_still_comes(
    robot: ZenohBus, console: ZenohBus, caplog: pytest.LogCaptureFixture
) -> None:
    inbox = Inbox()

    def take(received: Received) -> None:
        if received.payload == b"bad":
            raise ValueError("cannot take this")
        inbox.put(received)

    console.subscriber("status", take)
    publish_until_received(robot, "status", b"good", inbox)
    robot.put("status", b"bad")
    robot.put("status", b"after")
    received = inbox.next()
    while received.payload == b"good":
        received = inbox.next()
    assert received.payload == b"after"
    assert "cannot take this" in caplog.text


def test_latched_values_reach_those_who_come_later(robot: ZenohBus, endpoint: str) -> None:
    robot.latch("tf_static", b"old")
    robot.latch("tf_static", b"mounts")
    settings = ZenohSettings(connect=(endpoint,), mode="client")
    with ZenohBus(settings, PREFIX) as late:
        [reply] = ask(late, "tf_static")
        assert (reply.payload, reply.encoding) == (b"mounts", keys.encoding_of("tf_static"))
        inbox = Inbox()
        late.subscriber("tf_static", inbox.put, history=True)
        assert inbox.next().payload == b"mounts"
        robot.latch("tf_static", b"new mounts")
        assert inbox.next().payload == b"new mounts"


def test_late_joiners_get_the_cached_map_updates_in_order(robot: ZenohBus, endpoint: str) -> None:
    for k in range(5):
        robot.put("map/updates", bytes([k]))
    with ZenohBus(ZenohSettings(connect=(endpoint,), mode="client"), PREFIX) as late:
        inbox = Inbox()
        late.subscriber("map/updates", inbox.put, history=True)
        assert [inbox.next().payload for _ in range(5)] == [bytes([k]) for k in range(5)]


def test_a_console_that_stays_gets_the_latched_values_of_a_robot_that_restarts(endpoint: str) -> None:
    inbox = Inbox()
    robot = ZenohBus(ZenohSettings(listen=(endpoint,)), PREFIX)
    with ZenohBus(ZenohSettings(connect=(endpoint,), mode="client"), PREFIX) as console:
        console.subscriber("tf_static", inbox.put, history=True)
        robot.latch("tf_static", b"first")
        assert inbox.next().payload == b"first"
        robot.close()
        for _ in range(5):
            with ZenohBus(ZenohSettings(listen=(endpoint,)), PREFIX) as restarted:
                # On a busy machine the console may have found its way back already: then once more.
                if restarted.links() == 0:
                    restarted.latch("tf_static", b"second")
                    assert inbox.next().payload == b"second"
                    return
        pytest.fail("the console was always back before the robot had anything to say")


def test_wanted_says_whether_anybody_listens(robot: ZenohBus, console: ZenohBus) -> None:
    assert not robot.wanted("odom")
    inbox = Inbox()
    console.subscriber("odom", inbox.put)
    publish_until_received(robot, "odom", b"x", inbox)
    assert robot.wanted("odom")
    assert robot.links() == 1


def test_a_busy_port_is_one_clear_error(robot: ZenohBus, endpoint: str) -> None:
    with pytest.raises(ZenohSetupError) as caught:
        ZenohBus(ZenohSettings(listen=(endpoint,)), PREFIX)
    assert str(caught.value) == (
        f"[zenoh] listen {endpoint}: another program listens there; is the daemon running already?"
    )


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (ZenohSettings(listen=("garbage",)), r'\[zenoh\] listen/endpoints = \["garbage"\]: Endpoints must be of'),
        (ZenohSettings(listen=("foo/bar",)), "listen foo/bar.*not supported for foo protocol"),
        (ZenohSettings(connect=("tcp/127.0.0.1:9",), mode="client"), "cannot connect to tcp/127.0.0.1:9"),
        (ZenohSettings(further={"no/such": 1}), "no/such = 1"),
    ],
)
def test_impossible_settings_are_one_clear_error(settings: ZenohSettings, text: str) -> None:
    with pytest.raises(ZenohSetupError, match=text) as caught:
        ZenohBus(settings, PREFIX)
    assert "\n" not in str(caught.value)
    assert ".rs" not in str(caught.value)


def test_the_session_is_closed_to_what_was_not_asked_for() -> None:
    config = configuration(ZenohSettings())
    expected = {
        "scouting/multicast/enabled": "false",
        "scouting/gossip/enabled": "false",
        "transport/shared_memory/enabled": "false",
        "transport/link/rx/max_message_size": "1048576",
        "listen/endpoints": "[]",
    }
    assert {path: str(config.get_json(path)) for path in expected} == expected


def test_a_peer_without_a_reachable_other_still_starts() -> None:
    with ZenohBus(ZenohSettings(connect=(free_endpoint(),)), PREFIX) as alone:
        alone.put("pose", b"x")
        assert alone.links() == 0


def test_closing_twice_is_harmless() -> None:
    bus = ZenohBus(ZenohSettings(listen=(free_endpoint(),)), PREFIX)
    bus.put("pose", b"x")
    bus.close()
    bus.close()
