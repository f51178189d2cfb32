"""What ROS nodes on `rmw_zenoh` need (ROS 2 Jazzy and later): the robot as a node of their graph.

- Messages go to `<domain>/<topic>/<DDS type>/<type hash>`, each with an attachment of 33 bytes: its number, from 1
  (i64), the time of sending (i64, UNIX ns), the length of what follows (u8, 16), and the publisher's 16-byte gid;
  little-endian. A node does not take a message without it.
- Liveliness tokens make the graph: `@ros2_lv/<domain>/<zid>/<node>/<entity>/<kind>/<enclave>/<namespace>/<name>`, kind
  NN for the node; publishers (MP) have topic, DDS type, type hash and quality of service behind it, where what is empty
  has its default: reliable, volatile, keep the last 42. A `/` within a part is written `%`.
- A latched topic (TRANSIENT_LOCAL) has its history from Zenoh's AdvancedPublisher.

rmw_zenoh's gids are XXH3 of the token. Nodes only tell publishers apart by them: any other hash of 16 bytes will do.

Source: https://github.com/ros2/rmw_zenoh, docs/design.md; rmw_zenoh_cpp/src/detail: liveliness_utils.cpp (3411fde),
qos.cpp, attachment_helpers.cpp (534747d), rmw_publisher_data.cpp (3e19ec7).
"""

from __future__ import annotations

import hashlib
import struct
from functools import cache

from robominer_slam.publishing.ros_topics import RosTopic, topics_under

#: The node's name; its namespace is the robot's prefix.
NODE = "slam"
SLASH = "%"
GID_BYTES = 16
_ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")
#: RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL; volatile is the default and is left out.
_TRANSIENT_LOCAL = "1"


def dds_type(typename: str) -> str:
    """`nav_msgs/msg/Odometry` as DDS has it: `nav_msgs::msg::dds_::Odometry_`."""
    package, kind, name = typename.split("/")
    return f"{package}::{kind}::dds_::{name}_"


class RmwZenohLayout:
    """Tokens, keys and attachments for `rmw_zenoh`.

    Attributes:
        topics: the robot's.
    """

    def __init__(self, prefix: str, domain: int) -> None:
        self.topics = topics_under(prefix)
        self._namespace = f"/{prefix}"
        self._domain = domain
        self._numbers = {topic.key: number for number, topic in enumerate(self.topics, start=1)}

    @property
    def token_pattern(self) -> str:
        """Of the domain's whole graph: nodes subscribe to no less."""
        return f"@ros2_lv/{self._domain}/**"

    def tokens(self, session_id: str) -> list[str]:
        """One for the node and one for each topic."""
        return [self._token(session_id, 0, "NN"), *(self._publisher(topic, session_id) for topic in self.topics)]

    def data_key(self, topic: RosTopic) -> str:
        """The key of a topic's messages."""
        return f"{self._domain}{topic.name}/{dds_type(topic.typename)}/{topic.hash}"

    def attachment(self, topic: RosTopic, session_id: str, sequence: int, sent_ns: int, /) -> bytes:
        """Number, time and publisher of a message."""
        return _ATTACHMENT.pack(sequence, sent_ns, GID_BYTES, _gid(self._publisher(topic, session_id)))

    def _publisher(self, topic: RosTopic, session_id: str) -> str:
        token = self._token(session_id, self._numbers[topic.key], "MP")
        durability = _TRANSIENT_LOCAL if topic.latched else ""
        # Reliability, durability, history and depth, deadline, lifespan, liveliness.
        quality = f":{durability}:,{topic.depth}:,:,:,,"
        return f"{token}/{_mangled(topic.name)}/{dds_type(topic.typename)}/{topic.hash}/{quality}"

    def _token(self, session_id: str, entity: int, kind: str) -> str:
        place = f"{_mangled('/')}/{_mangled(self._namespace)}/{NODE}"
        return f"@ros2_lv/{self._domain}/{session_id}/0/{entity}/{kind}/{place}"


def _mangled(name: str) -> str:
    return name.replace("/", SLASH)


@cache
def _gid(token: str) -> bytes:
    return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()
