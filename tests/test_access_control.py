"""Who may do what, through real TLS sessions with real certificates: nothing here is a stand-in for Zenoh."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from robominer_slam.configuration.zenoh_section import ZenohSection
from robominer_slam.publishing.bus_messages import Query, QueryError, Received, Reply
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.senders import LOCAL, Peer, sender
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSetupError
from robominer_slam.security.access_list import AccessList
from robominer_slam.security.access_rules import access_control
from tests.secured_robot import LIMIT_S, PREFIX, REFUSED_S, Inbox, SecuredRobot

ANSWERED_S = 1.0


class Commands:
    """Stands where the daemon's commands stand: acknowledges, and remembers who asked."""

    def __init__(self) -> None:
        self.senders: list[str] = []

    def __call__(self, query: Query) -> Reply:
        self.senders.append(query.sender)
        return Reply(b'{"ok": true}')


@pytest.fixture(scope="module")
def commands() -> Commands:
    return Commands()


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory, commands: Commands) -> Iterator[SecuredRobot]:
    robot = SecuredRobot(tmp_path_factory.mktemp("secured"))
    with robot.bus:
        robot.bus.queryable("cmd/*", commands)
        robot.bus.queryable("map/snapshot", lambda _: Reply(b"the map"))
        for i in range(3):
            robot.bus.put("map/updates", b"update %d" % i)
        yield robot


def allowed(bus: ZenohBus, key: str) -> bool:
    try:
        bus.get(key, timeout_s=ANSWERED_S)
    except QueryError:
        return False
    return True


@pytest.mark.parametrize(
    ("name", "looks", "acts"),
    [("alice", True, True), ("bob", True, False), ("mallory", False, False), (None, True, True)],
)
def test_each_role_may_do_what_it_may_and_no_more(robot: SecuredRobot, name: str | None, looks: bool, acts: bool):
    with robot.client(name) as bus:
        assert bus.links() == 1, "also who was revoked connects: that is what Zenoh cannot prevent"
        assert allowed(bus, "map/snapshot") == looks
        assert allowed(bus, "cmd/pause") == acts


def test_a_late_joiner_gets_the_maps_history(robot: SecuredRobot):
    with robot.client("bob") as bus:
        inbox = Inbox(bus, "map/updates", history=True)
        got = {received.payload for received in inbox.until(lambda received: received.payload == b"update 2")}
    assert got >= {b"update 0", b"update 2"}


def test_a_revoked_name_hears_nothing_of_what_others_hear(robot: SecuredRobot):
    with robot.client("mallory") as revoked, robot.client("bob") as viewer:
        silent = Inbox(revoked, "telemetry", "pose", "status", "**", "map/updates")
        heard = Inbox(viewer, "telemetry")
        heard.synchronise(robot.bus)
        for i in range(20):
            heard.marker(robot.bus, b"round %d" % i)
        assert not silent.waiting()


@pytest.mark.parametrize("bundle", ["late", "foreign", "nothing"])
def test_expired_foreign_and_missing_certificates_are_refused(robot: SecuredRobot, bundle: str, tmp_path: Path):
    if bundle == "nothing":
        with pytest.raises(ZenohSetupError, match="expected --credentials FOLDER"):
            client_settings(robot.tls)
        settings = client_settings(robot.tls, robot.bundle("alice"), REFUSED_S)
        further = {key: value for key, value in settings.further.items() if "/connect_" not in key}
        settings = type(settings)(connect=settings.connect, mode="client", connect_timeout_s=REFUSED_S, further=further)
    else:
        folder = robot.foreign.bundle("alice") if bundle == "foreign" else robot.bundle(bundle)
        settings = client_settings(robot.tls, folder, REFUSED_S)
    with pytest.raises(ZenohSetupError, match="doctor"):
        ZenohBus(settings, PREFIX)


def test_a_foreign_key_that_knows_the_robots_authority_is_refused_too(robot: SecuredRobot, tmp_path: Path):
    """The robot refuses, not only the client: here the client would take the robot."""
    stolen = robot.foreign.bundle("alice")
    for name in ("alice.key", "alice.pem"):
        (tmp_path / name).write_bytes((stolen / name).read_bytes())
    (tmp_path / "ca.pem").write_bytes((robot.bundle("bob") / "ca.pem").read_bytes())
    with pytest.raises(ZenohSetupError):
        ZenohBus(client_settings(robot.tls, tmp_path, REFUSED_S), PREFIX)


@pytest.mark.parametrize("name", ["alice", "bob"])
def test_nobody_can_speak_as_the_robot(robot: SecuredRobot, name: str):
    with robot.client(name) as false, robot.client(None) as local:
        taken = Inbox(robot.bus, "**")
        heard = Inbox(local, "pose", "map/updates", "telemetry")
        heard.synchronise(robot.bus)
        for key in ("pose", "map/updates", "telemetry", "cmd/pause", "status"):
            false.put(key, b"spoofed")
        false.put("raw/imu", b"spoofed", "application/cdr;x")
        false.queryable("map/snapshot", lambda _: Reply(b"a false map"))
        # On the same link, behind what was put: when this is answered, all of that has been judged.
        assert allowed(false, "map/snapshot")
        assert {received.payload for received in local.get("map/snapshot")} == {b"the map"}
        local.put("pose", b"from within")
        found = taken.until(lambda received: received.payload == b"from within")
        assert b"spoofed" not in {received.payload for received in found}
        assert b"spoofed" not in {received.payload for received in heard.marker(robot.bus, b"end")}


def test_another_board_of_the_robot_sends_its_raw_sensors(robot: SecuredRobot):
    section = ZenohSection(credentials=str(robot.bundle("front-board")), listen=(), connect=(robot.tls,))
    taken = Inbox(robot.bus, "raw/*")
    with ZenohBus(robot_settings(section, Path(), PREFIX), PREFIX) as board:
        stop = threading.Event()

        def send() -> None:
            while not stop.wait(0.05):
                board.put("raw/imu", b"raw", "application/cdr;sensor_msgs/msg/Imu")

        thread = threading.Thread(target=send)
        thread.start()
        try:
            assert taken.until(lambda received: received.payload == b"raw")[-1].key == "raw/imu"
        finally:
            stop.set()
            thread.join(LIMIT_S)


def test_a_commands_sender_is_the_name_in_the_certificate(robot: SecuredRobot, commands: Commands):
    with robot.client("alice") as alice, robot.client("bob"), robot.client("mallory"):
        assert allowed(alice, "cmd/pause")
        assert commands.senders[-1] == "alice", "those who may not command leave no doubt"
        with robot.client(None) as local:
            assert allowed(alice, "cmd/pause")
            assert commands.senders[-1] == "alice (by its own word)"
            assert allowed(local, "cmd/pause")
            assert commands.senders[-1] == f"{LOCAL} (by its own word)"


@pytest.mark.parametrize(
    ("peers", "claimed", "expected"),
    [
        ([Peer("1", "alice")], None, "alice"),
        ([Peer("1", "alice")], "2", "alice"),
        ([Peer("1", "alice"), Peer("2", None)], "3", f"one of {LOCAL}, alice"),
        ([Peer("1", None), Peer("2", None)], None, LOCAL),
        ([], "3", "Zenoh id 3"),
        ([], None, "unknown"),
    ],
)
def test_a_sender_is_told_no_surer_than_it_is(peers: list[Peer], claimed: str | None, expected: str):
    assert sender(peers, claimed) == expected


def test_a_role_that_nobody_has_is_not_everybodys():
    rules = access_control(AccessList({}), PREFIX)
    assert [subject["id"] for subject in rules["subjects"]] == ["local"]
    assert rules["default_permission"] == "deny"


@pytest.mark.parametrize("remote_ros", [False, True])
def test_a_remote_link_gets_little_of_the_ros_topics_and_a_local_one_everything(tmp_path: Path, remote_ros: bool):
    frames, keys = 20, ("pose", "odom", "tf")
    robot = SecuredRobot(tmp_path, remote_ros=remote_ros)
    with robot.bus, robot.client("alice") as remote, robot.client(None) as local:
        far, near = Inbox(remote, *keys, "telemetry"), Inbox(local, *keys, "telemetry")
        far.synchronise(robot.bus)
        near.synchronise(robot.bus)
        begun = time.monotonic()
        for i in range(frames):
            for key in keys:
                near.insist(robot.bus, key, b"frame %d" % i)
                if remote_ros:
                    far.insist(robot.bus, key, b"far %d" % i)
        # Poses do come, if seldom.
        far.insist(robot.bus, "pose", b"last")
        seconds = time.monotonic() - begun
    counts = Counter(received.key for received in far.seen if received.key in keys)
    if not remote_ros:
        for key, rate in (("pose", 1.0), ("odom", 0.1), ("tf", 0.1)):
            assert counts[key] <= 1 + seconds * rate, key


def test_a_remote_link_gets_the_short_status_and_a_local_one_the_full(tmp_path: Path):
    full, short = b"f" * 1500, b"s" * 400
    robot = SecuredRobot(tmp_path)
    with robot.bus, robot.client("alice") as remote, robot.client(None) as local:
        far, near = Inbox(remote, "status", "telemetry"), Inbox(local, "status", "telemetry")
        far.synchronise(robot.bus)
        near.synchronise(robot.bus)
        far.waiting(), near.waiting()
        robot.bus.put("status", full)
        robot.bus.put("status", short)
        # Half a second later the local link takes one again, and a link keeps the order of a key.
        heard: list[Received] = []
        while b"end" not in {received.payload for received in heard}:
            robot.bus.put("status", b"end")
            heard += near.marker(robot.bus, b"round")
        heard_far = far.until(lambda received: received.payload == b"end")
    assert [r.payload for r in heard if r.key == "status"][:2] == [full, b"end"]
    assert [r.payload for r in heard_far if r.key == "status"] == [short, b"end"]
