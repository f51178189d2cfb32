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
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore

from drivers.ros_definitions import DEFINITIONS
from robominer_slam.configuration.file import ConfigurationError, parse
from robominer_slam.publishing.ros_bridge import RosSettings
from tests.ros_node import (
    DOMAIN,
    LIMIT_S,
    MESSAGES,
    MOUNTS,
    PREFIX,
    TOPICS,
    Robot,
    check_decoded,
    publish,
    rmw_key,
    robot_shown_to,
)


@pytest.fixture
def rmw_zenoh() -> Iterator[Robot]:
    yield from robot_shown_to(RosSettings("rmw_zenoh", DOMAIN))


@pytest.fixture
def ros2dds() -> Iterator[Robot]:
    yield from robot_shown_to(RosSettings("ros2dds"))


@pytest.fixture
def plain() -> Iterator[Robot]:
    yield from robot_shown_to(None)


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
