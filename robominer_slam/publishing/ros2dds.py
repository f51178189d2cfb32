"""What `zenoh-bridge-ros2dds` needs: the bridge between Zenoh and ROS 2 on DDS.

The bridge takes a Zenoh key for a topic's name, the payload for its CDR, and learns what there is from liveliness
tokens: `@/<zid>/@ros2_lv` for a participant, and for each publisher

    @/<zid>/@ros2_lv/MP/<key>/<type>/<keyless>:<reliability>:<durability>:<history>,<depth>:<user data>

with `/` written as U+00A7 within a part. The user data are those of the DDS writer that the bridge makes; since ROS
Iron they carry the type's hash. Bridges from before December 2024 take no tokens with user data.

Source: https://github.com/eclipse-zenoh/zenoh-plugin-ros2dds: liveliness_mgt.rs (formats; ef5b953), pull request 349
(user data), route_subscriber.rs (messages, and the history of latched topics; ebdb1e0).
"""

from __future__ import annotations

from robominer_slam.publishing.ros_topics import RosTopic, topics_under

SLASH = "\u00a7"
#: Numbers of cyclors (CycloneDDS): dds_reliability_kind_t, dds_durability_kind_t, dds_history_kind_t.
_RELIABLE = 1
_VOLATILE, _TRANSIENT_LOCAL = 0, 1
_KEEP_LAST = 0
#: ROS topics have no keys; the bridge writes `K` for those that do.
_KEYLESS = ""


class Ros2DdsLayout:
    """Tokens and keys for `zenoh-bridge-ros2dds`.

    Attributes:
        topics: the robot's.
    """

    token_pattern = "@/*/@ros2_lv/**"

    def __init__(self, prefix: str) -> None:
        self.topics = topics_under(prefix)
        self._own = f"{prefix}/"

    def tokens(self, session_id: str) -> list[str]:
        """One for the robot and one for each topic."""
        robot = f"@/{session_id}/@ros2_lv"
        return [robot, *(f"{robot}/MP/{self._publisher(topic)}" for topic in self.topics)]

    def data_key(self, topic: RosTopic) -> str | None:
        """The topic's name without its slash, which is the robot's own key but for the transforms."""
        key = topic.name.removeprefix("/")
        return None if key == self._own + topic.key else key

    def attachment(self, _topic: RosTopic, _session_id: str, _sequence: int, _sent_ns: int, /) -> None:
        """None."""
        return

    @staticmethod
    def _publisher(topic: RosTopic) -> str:
        key, typename = (text.replace("/", SLASH) for text in (topic.name.removeprefix("/"), topic.typename))
        durability = _TRANSIENT_LOCAL if topic.latched else _VOLATILE
        quality = f"{_KEYLESS}:{_RELIABLE}:{durability}:{_KEEP_LAST},{topic.depth}:typehash={topic.hash};"
        return f"{key}/{typename}/{quality}"
