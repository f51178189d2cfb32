"""The ROS topics of a robot: the keys that carry ROS messages, under the names that ROS knows them by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

from drivers.ros_messages import type_hash
from robominer_slam.publishing.keys import encoding_of, qos_of

#: Who is to see the topics: nobody in ROS; `zenoh-bridge-ros2dds`; ROS nodes that run on `rmw_zenoh`.
RosBridgeName: TypeAlias = Literal["none", "ros2dds", "rmw_zenoh"]

#: Keys under the prefix that are published as ROS messages. `raw/<device>` stays between the robot's own boards.
ROS_KEYS = ("pose", "odom", "tf", "tf_static", "path", "whiskers/points", "status")
#: Where every ROS program looks for them, whatever the robot.
_GLOBAL = ("tf", "tf_static")
#: What ROS programs ask for by default, and what `ros2 topic info` then shows.
DEPTH = 10


@dataclass(frozen=True, slots=True)
class RosTopic:
    """A topic.

    Attributes:
        key: under the robot's prefix.
        name: in ROS, with its slash.
        typename: such as `nav_msgs/msg/Odometry`.
        hash: of the type's definition, `RIHS01_` and 64 digits (REP-2016).
        latched: late joiners get the last message (durability TRANSIENT_LOCAL).
        depth: messages that are kept for a reader.
    """

    key: str
    name: str
    typename: str
    hash: str
    latched: bool
    depth: int


class RosLayout(Protocol):
    """What one of the bridges needs on the network."""

    @property
    def topics(self) -> tuple[RosTopic, ...]:
        """The robot's topics."""
        ...

    def tokens(self, session_id: str) -> list[str]:
        """Keys of the liveliness tokens that announce the robot and its topics."""
        ...

    def data_key(self, topic: RosTopic) -> str | None:
        """The whole key that a topic's messages go to; None where the robot's own key is the right one."""
        ...

    def attachment(self, topic: RosTopic, session_id: str, sequence: int, sent_ns: int, /) -> bytes | None:
        """What travels beside a message; `sequence` counts a topic's messages from 1."""
        ...

    @property
    def token_pattern(self) -> str:
        """Matches the tokens; the very pattern that the other side subscribes to."""
        ...


def ros_name(prefix: str, key: str) -> str:
    """What ROS calls a key under the robot's prefix."""
    return f"/{key}" if key in _GLOBAL else f"/{prefix}/{key}"


def topics_under(prefix: str) -> tuple[RosTopic, ...]:
    """The topics of a robot with this prefix, `robominer/<id>`."""
    found = []
    for key in ROS_KEYS:
        typename = encoding_of(key).partition(";")[2]
        latched = qos_of(key).cache > 0
        found.append(
            RosTopic(key, ros_name(prefix, key), typename, type_hash(typename), latched, 1 if latched else DEPTH)
        )
    return tuple(found)
