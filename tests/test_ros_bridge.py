"""What ROS 2 sees of a robot, over real Zenoh sessions: topics listed, messages decoded by others' programs.

`zenoh-ros2-sdk` stands for a ROS node on rmw_zenoh: its session settings are rmw_zenoh's, its type hashes and its
parser of tokens its own. For zenoh-bridge-ros2dds no other program in Python is known: the parser below is written
from the bridge's own source (liveliness_mgt.rs, `parse_ke_liveliness_pub`).
"""

from __future__ import annotations

import json
import os
import queue
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import zenoh
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_typestore

from drivers.ros_definitions import DEFINITIONS
from drivers.ros_messages import schema_text
from robominer_slam.configuration.file import ConfigurationError, parse
from robominer_slam.publishing import cloud_messages, pose_messages, report_messages
from robominer_slam.publishing.pose_messages import StampedTransform
from robominer_slam.publishing.report_messages import Diagnostic, Level
from robominer_slam.publishing.ros_bridge import RosSettings
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings
from tests.secured_robot import free_ports

PREFIX = "robominer/rm3"
LIMIT_S = 15.0
STAMP_NS = 1_700_000_000_123_456_789
POSE = np.array([1.0, 2.0, 0.5, 0.0, 0.0, 0.6, 0.8])
DOMAIN = 7

#: As `ros2 topic list -t` is to show them.
TOPICS = {
    "/robominer/rm3/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/robominer/rm3/odom": "nav_msgs/msg/Odometry",
    "/robominer/rm3/path": "nav_msgs/msg/Path",
    "/robominer/rm3/whiskers/points": "sensor_msgs/msg/PointCloud2",
    "/robominer/rm3/status": "diagnostic_msgs/msg/DiagnosticArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}
MESSAGES: dict[str, bytes] = {
    "pose": pose_messages.pose_with_covariance(STAMP_NS, "map", POSE, np.eye(6)),
    "odom": pose_messages.odometry(STAMP_NS, "odom", "base_link", POSE, np.eye(6), np.arange(6.0), np.eye(6)),
    "path": pose_messages.path(STAMP_NS, "map", [STAMP_NS], POSE[None]),
    "whiskers/points": cloud_messages.contact_cloud(
        STAMP_NS, "base_link", np.ones((2, 3)), np.arange(2), np.zeros(2), np.zeros(2)
    ),
    "status": report_messages.diagnostics(STAMP_NS, [Diagnostic("slam", Level.WARN, "slips", {"keyframes": "4"})]),
    "tf": pose_messages.transforms([StampedTransform(STAMP_NS, "odom", "base_link", POSE)]),
}
MOUNTS = pose_messages.transforms([StampedTransform(STAMP_NS, "base_link", "whisker_0_0", POSE)])


def key_of(topic: str) -> str:
    return topic.removeprefix("/").removeprefix(f"{PREFIX}/")


def publish(bus: ZenohBus) -> None:
    for key, message in MESSAGES.items():
        bus.put(key, message)


class Heard(NamedTuple):
    key: str
    payload: bytes
    attachment: bytes | None


class Node:
    """Somebody else's program: a peer beside the robot, with rmw_zenoh's settings of a session where it matters."""

    def __init__(self, endpoint: str) -> None:
        config = zenoh.Config()
        for path, value in (
            ("mode", '"peer"'),
            ("connect/endpoints", f'["{endpoint}"]'),
            ("listen/endpoints", '["tcp/127.0.0.1:0"]'),
            ("scouting/multicast/enabled", "false"),
            ("timestamping/enabled", '{"router": true, "peer": true, "client": true}'),
        ):
            config.insert_json5(path, value)
        self.session = zenoh.open(config)
        self._heard: queue.Queue[Heard] = queue.Queue()
        self._declared: list[Any] = []

    def take(self, sample: zenoh.Sample) -> None:
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        self._heard.put(Heard(str(sample.key_expr), sample.payload.to_bytes(), attachment))

    def subscribe(self, *keys: str) -> None:
        self._declared += [self.session.declare_subscriber(key, self.take) for key in keys]

    def subscribe_latched(self, key: str) -> None:
        """As rmw_zenoh and the bridge subscribe to TRANSIENT_LOCAL topics."""
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        self._declared.append(zenoh.ext.declare_advanced_subscriber(self.session, key, self.take, history=history))

    def hear(self, keys: set[str], again: Callable[[], None]) -> dict[str, Heard]:
        """One message of each key; what is published may come before the subscription is known, so `again`."""
        found: dict[str, Heard] = {}
        end = time.monotonic() + LIMIT_S
        while keys - found.keys():
            assert time.monotonic() < end, keys - found.keys()
            again()
            try:
                while True:
                    heard = self._heard.get(timeout=0.1)
                    found[heard.key] = heard
            except queue.Empty:
                continue
        return found

    def tokens(self, pattern: str, wanted: int) -> list[str]:
        end = time.monotonic() + LIMIT_S
        while True:
            replies = list(self.session.liveliness().get(pattern, timeout=1.0))
            found = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
            if len(found) >= wanted or time.monotonic() > end:
                return found
            time.sleep(0.05)

    def close(self) -> None:
        for one in self._declared:
            one.undeclare()
        self.session.close()


class Robot(NamedTuple):
    bus: ZenohBus
    node: Node
    port: int


def robot_shown_to(settings: RosSettings | None) -> Iterator[Robot]:
    [port] = free_ports(1)
    endpoint = f"tcp/127.0.0.1:{port}"
    with ZenohBus(ZenohSettings(listen=(endpoint,), ros=settings), PREFIX) as bus:
        bus.latch("tf_static", MOUNTS)
        node = Node(endpoint)
        yield Robot(bus, node, port)
        node.close()


@pytest.fixture
def rmw_zenoh() -> Iterator[Robot]:
    yield from robot_shown_to(RosSettings("rmw_zenoh", DOMAIN))


@pytest.fixture
def ros2dds() -> Iterator[Robot]:
    yield from robot_shown_to(RosSettings("ros2dds"))


@pytest.fixture
def plain() -> Iterator[Robot]:
    yield from robot_shown_to(None)


def check_decoded(topic: str, payload: bytes) -> None:
    """By two decoders that know the types from elsewhere: rosbags' store of ROS 2 Jazzy, and mcap-ros2-support."""
    typename = TOPICS[topic]
    by_rosbags = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(payload, typename)
    package, _, name = typename.split("/")
    decoders = generate_dynamic(f"{package}/{name}", schema_text(typename))
    by_mcap: Any = decoders[f"{package}/{name}"](payload)
    for message in (by_rosbags, by_mcap):
        match topic.rsplit("/", 1)[1]:
            case "pose":
                assert message.header.frame_id == "map"
                assert message.pose.pose.position.y == 2.0
                assert list(message.pose.covariance) == list(np.eye(6).ravel())
            case "odom":
                assert message.child_frame_id == "base_link"
                assert message.twist.twist.angular.z == 5.0
            case "path":
                assert [p.pose.orientation.w for p in message.poses] == [0.8]
            case "points":
                assert [field.name for field in message.fields] == ["x", "y", "z", "index", "inclination", "azimuth"]
                assert message.width == 2
            case "status":
                assert [(s.name, s.values[0].value) for s in message.status] == [("slam", "4")]
            case "tf":
                assert [t.child_frame_id for t in message.transforms] == ["base_link"]
            case "tf_static":
                assert [t.child_frame_id for t in message.transforms] == ["whisker_0_0"]
            case other:
                raise AssertionError(other)


def rmw_key(topic: str) -> str:
    package, _, name = TOPICS[topic].split("/")
    digest = get_typestore(Stores.ROS2_JAZZY).hash_rihs01(TOPICS[topic])
    return f"{DOMAIN}{topic}/{package}::msg::dds_::{name}_/{digest}"


def test_nodes_on_rmw_zenoh_get_every_message_with_its_attachment(rmw_zenoh: Robot) -> None:
    bus, node, _ = rmw_zenoh
    node.subscribe(*(rmw_key(topic) for topic in TOPICS if topic != "/tf_static"))
    node.subscribe_latched(rmw_key("/tf_static"))
    heard = node.hear({rmw_key(topic) for topic in TOPICS}, lambda: publish(bus))
    gids = set()
    for topic in TOPICS:
        message = heard[rmw_key(topic)]
        check_decoded(topic, message.payload)
        assert message.attachment is not None
        assert len(message.attachment) == 33
        sequence, sent_ns, length = struct.unpack("<qqB", message.attachment[:17])
        assert sequence >= 1
        assert abs(sent_ns - time.time_ns()) < 60e9
        assert length == 16
        gids.add(message.attachment[17:])
    assert len(gids) == len(TOPICS)


def test_a_topics_messages_are_counted_from_one(rmw_zenoh: Robot) -> None:
    bus, node, _ = rmw_zenoh
    # The latched message is the first of its topic, and whoever comes late still gets it.
    node.subscribe_latched(rmw_key("/tf_static"))
    first = node.hear({rmw_key("/tf_static")}, lambda: None)[rmw_key("/tf_static")]
    bus.latch("tf_static", MOUNTS)
    second = node.hear({rmw_key("/tf_static")}, lambda: None)[rmw_key("/tf_static")]
    assert [struct.unpack("<q", m.attachment[:8])[0] for m in (first, second) if m.attachment] == [1, 2]


def test_own_keys_stay_as_they_are_and_nothing_is_wanted_that_nobody_hears(rmw_zenoh: Robot) -> None:
    bus, node, _ = rmw_zenoh
    assert not bus.wanted("whiskers/points")
    node.subscribe(f"{PREFIX}/pose")
    own = node.hear({f"{PREFIX}/pose"}, lambda: publish(bus))[f"{PREFIX}/pose"]
    assert (own.payload, own.attachment) == (MESSAGES["pose"], None)
    assert not bus.wanted("whiskers/points")
    node.subscribe(rmw_key("/robominer/rm3/whiskers/points"))
    node.hear({rmw_key("/robominer/rm3/whiskers/points")}, lambda: publish(bus))
    assert bus.wanted("whiskers/points")


#: In a process of its own: the library keeps one session for its process. Prints what `ros2 topic list -t` and
#: `ros2 topic info -v` would, then one pose that it has decoded by its own type hash.
NODE_PROGRAM = """
import json, queue, sys
import rosbags.typesys
from zenoh_ros2_sdk import ROS2Subscriber, discovery, utils
port, domain, topic, typename, wanted = int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:5], int(sys.argv[5])
listed = []
while len(listed) < wanted:
    listed = discovery.get_topic_names_and_types(domain_id=domain, router_port=port, timeout=1.0)
info = {}
for name, _ in listed:
    found = discovery.get_topic_info(name, domain_id=domain, router_port=port, timeout=1.0, verbose=True)
    info[name] = [[p.node_namespace, p.node_name, p.type_hash, p.qos] for p in found.publishers]
print(json.dumps({"listed": listed, "info": info}), flush=True)
definitions = json.loads(sys.stdin.readline())
text = definitions.pop(typename)
digest = utils.get_type_hash(typename, msg_definition=text, dependencies=definitions)
heard = queue.Queue()
store = rosbags.typesys.get_typestore(rosbags.typesys.Stores.ROS2_HUMBLE)
from zenoh_ros2_sdk.session import ZenohSession
session = ZenohSession.get_instance("127.0.0.1", port)
session.store = store
session._registered_types[typename] = typename
subscriber = ROS2Subscriber(
    topic=topic, msg_type=typename, callback=heard.put, msg_definition=text, domain_id=domain, router_port=port,
    type_hash=digest,
)
message = heard.get(timeout=20)
print(json.dumps({"hash": digest, "y": message.pose.pose.position.y, "frame": message.header.frame_id}), flush=True)
subscriber.close()
session.session.close()
"""


def test_a_foreign_library_lists_the_topics_and_reads_them(rmw_zenoh: Robot, tmp_path: Path) -> None:
    topic = "/robominer/rm3/pose"
    arguments = [str(rmw_zenoh.port), str(DOMAIN), topic, TOPICS[topic], str(len(TOPICS))]
    environment = {**os.environ, "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", NODE_PROGRAM, *arguments],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            seen = json.loads(process.stdout.readline())
            process.stdin.write(json.dumps(DEFINITIONS) + "\n")
            process.stdin.flush()
            lines: queue.Queue[str] = queue.Queue()
            threading.Thread(target=lambda: lines.put(process.stdout.readline()), daemon=True).start()
            end = time.monotonic() + 2 * LIMIT_S
            while lines.empty() and time.monotonic() < end:
                publish(rmw_zenoh.bus)
                time.sleep(0.05)
            read = json.loads(lines.get(timeout=1.0))
        finally:
            process.kill()
    assert dict(seen["listed"]) == {name: [kind] for name, kind in TOPICS.items()}
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, kind in TOPICS.items():
        quality = ":1:,1:,:,:,," if name == "/tf_static" else "::,10:,:,:,,"
        assert seen["info"][name] == [["/robominer/rm3", "slam", store.hash_rihs01(kind), quality]]
    assert read == {"hash": store.hash_rihs01(TOPICS[topic]), "y": 2.0, "frame": "map"}


class BridgePublisher(NamedTuple):
    """A token as `parse_ke_liveliness_pub` and `key_expr_to_qos` of the bridge take it apart."""

    session_id: str
    key: str
    typename: str
    keyless: bool
    reliability: int
    durability: int
    history: int
    depth: int
    user_data: str


def parsed(token: str) -> BridgePublisher:
    at, session_id, space, kind, key, typename, quality = token.split("/")
    assert (at, space, kind) == ("@", "@ros2_lv", "MP")
    keyless, reliability, durability, history, user_data = quality.split(":", 4)
    policy, depth = history.split(",")
    key, typename = key.replace("\u00a7", "/"), typename.replace("\u00a7", "/")
    numbers = (int(number) for number in (reliability, durability, policy, depth))
    return BridgePublisher(session_id, key, typename, keyless == "", *numbers, user_data)


def test_the_bridge_to_dds_is_told_every_topic(ros2dds: Robot) -> None:
    bus, node, _ = ros2dds
    tokens = node.tokens("@/*/@ros2_lv/**", 1 + len(TOPICS))
    robots = [token for token in tokens if token.endswith("/@ros2_lv")]
    publishers = [parsed(token) for token in tokens if token not in robots]
    assert robots == [f"@/{publishers[0].session_id}/@ros2_lv"]
    store = get_typestore(Stores.ROS2_JAZZY)
    assert {f"/{p.key}": p.typename for p in publishers} == TOPICS
    for p in publishers:
        assert p.keyless
        assert p.user_data == f"typehash={store.hash_rihs01(p.typename)};"
        # Reliable; the mounts are transient local, the rest is volatile; keep last.
        expected = (1, 1, 0, 1) if p.key == "tf_static" else (1, 0, 0, 10)
        assert (p.reliability, p.durability, p.history, p.depth) == expected
    node.subscribe(*(p.key for p in publishers if not p.durability))
    node.subscribe_latched("tf_static")
    heard = node.hear({p.key for p in publishers}, lambda: publish(bus))
    for topic in TOPICS:
        check_decoded(topic, heard[topic.removeprefix("/")].payload)
        assert heard[topic.removeprefix("/")].attachment is None


def test_tokens_go_when_the_robot_goes(rmw_zenoh: Robot) -> None:
    bus, node, _ = rmw_zenoh
    pattern = f"@ros2_lv/{DOMAIN}/**"
    assert len(node.tokens(pattern, 1 + len(TOPICS))) == 1 + len(TOPICS)
    gone: queue.Queue[str] = queue.Queue()
    watcher = node.session.liveliness().declare_subscriber(
        pattern, lambda s: gone.put(str(s.key_expr)) if s.kind == zenoh.SampleKind.DELETE else None
    )
    bus.close()
    assert len({gone.get(timeout=LIMIT_S) for _ in range(1 + len(TOPICS))}) == 1 + len(TOPICS)
    watcher.undeclare()


def test_without_ros_there_is_nothing_of_it(plain: Robot) -> None:
    bus, node, _ = plain
    node.subscribe("tf", f"{PREFIX}/tf", "*/robominer/**")
    heard = node.hear({f"{PREFIX}/tf"}, lambda: publish(bus))
    assert set(heard) == {f"{PREFIX}/tf"}
    assert node.tokens("@ros2_lv/**", 0) == []
    assert node.tokens("@/*/@ros2_lv/**", 0) == []


@pytest.mark.parametrize("name", ["front-1", "2nd", "a__b"])
def test_a_robots_id_that_ros_cannot_say_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match=r"a robot\.id that ROS takes for a name") as caught:
        parse(f'[robot]\nid = "{name}"\n[zenoh]\nros = "ros2dds"\n', "file.toml")
    assert "\n" not in str(caught.value)
    assert parse(f'[robot]\nid = "{name}"\n', "file.toml").robot.id == name
