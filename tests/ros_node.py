"""Somebody else's program beside a robot that is shown to ROS, and what it is to find there."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import zenoh
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_typestore

from drivers.ros_messages import schema_text
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
