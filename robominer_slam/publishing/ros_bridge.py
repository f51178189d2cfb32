"""The robot's topics as ROS 2 sees them: tokens that announce them, and copies of messages where ROS wants them.

A message is encoded once; what is put on a second key are the same bytes. Without `[zenoh] ros` none of this exists.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import zenoh

from robominer_slam.publishing.keys import encoding_of, qos_of
from robominer_slam.publishing.publishers import Publisher, declare, somebody_listens
from robominer_slam.publishing.rmw_zenoh import RmwZenohLayout
from robominer_slam.publishing.ros2dds import Ros2DdsLayout
from robominer_slam.publishing.ros_topics import RosBridgeName, RosLayout, RosTopic

#: As rmw_zenoh's own publishers of latched topics (SAMPLE_MISS_DETECTION_HEARTBEAT_PERIOD), s.
_HEARTBEAT_S = 0.5


@dataclass(frozen=True, slots=True)
class RosSettings:
    """Who in ROS is to see the topics.

    Attributes:
        bridge: `ros2dds` or `rmw_zenoh`.
        domain: the ROS domain, ROS_DOMAIN_ID; `ros2dds` has its own setting of it.
    """

    bridge: RosBridgeName
    domain: int = 0


def ros_layout(settings: RosSettings, prefix: str) -> RosLayout | None:
    """What the bridge needs of a robot with this prefix; None for no bridge."""
    match settings.bridge:
        case "ros2dds":
            return Ros2DdsLayout(prefix)
        case "rmw_zenoh":
            return RmwZenohLayout(prefix, settings.domain)
        case "none":
            return None


def ros_keys(layout: RosLayout) -> dict[str, str]:
    """Whole keys beside the robot's own that messages go to, each with the own key whose copy it is."""
    return {key: topic.key for topic in layout.topics if (key := layout.data_key(topic)) is not None}


def ros_readable(layout: RosLayout) -> tuple[str, ...]:
    """Whole keys that those who may look need beside the robot's own: announcements, messages, histories."""
    keys = ros_keys(layout)
    latched = {topic.key for topic in layout.topics if topic.latched}
    histories = (f"{key}/@adv/**" for key, own in keys.items() if own in latched)
    return (layout.token_pattern, *keys, *histories)


@dataclass(frozen=True, slots=True)
class _Copy:
    topic: RosTopic
    publisher: Publisher
    encoding: str
    sequence: Iterator[int]


class RosBridge:
    """Tokens and publishers on an open session; close it before the session."""

    def __init__(self, session: zenoh.Session, layout: RosLayout) -> None:
        """Announce the topics, after their publishers are there."""
        self._layout = layout
        self._session_id = str(session.info.zid())
        self._copies: dict[str, _Copy] = {}
        for topic in layout.topics:
            key = layout.data_key(topic)
            if key is not None:
                publisher = _declare(session, key, topic)
                # Counting up is one step that no other thread can come between.
                self._copies[topic.key] = _Copy(topic, publisher, encoding_of(topic.key), itertools.count(1))
        tokens = layout.tokens(self._session_id)
        self._tokens = [session.liveliness().declare_token(token) for token in tokens]

    def put(self, key: str, payload: bytes) -> None:
        """Give ROS a message that was put on one of the robot's keys; where it goes there anyway, nothing happens."""
        copy = self._copies.get(key)
        if copy is not None:
            attachment = self._layout.attachment(copy.topic, self._session_id, next(copy.sequence), time.time_ns())
            copy.publisher.put(payload, encoding=copy.encoding, attachment=attachment)

    def wanted(self, key: str) -> bool:
        """Whether a ROS node subscribes to what a key carries."""
        copy = self._copies.get(key)
        return copy is not None and somebody_listens(copy.publisher, unknown=False)

    def close(self) -> None:
        """Take the announcements back, then the publishers."""
        # Zenoh's stubs leave these methods without a return type.
        leave: list[Callable[[], None]] = [token.undeclare for token in self._tokens]
        leave += [copy.publisher.undeclare for copy in self._copies.values()]
        self._tokens, self._copies = [], {}
        for step in leave:
            step()


def open_bridge(session: zenoh.Session, settings: RosSettings | None, prefix: str) -> RosBridge | None:
    """What the settings ask for; None where that is nothing."""
    layout = None if settings is None else ros_layout(settings, prefix)
    return None if layout is None else RosBridge(session, layout)


def _declare(session: zenoh.Session, key: str, topic: RosTopic) -> Publisher:
    qos = qos_of(topic.key)
    return declare(session, key, qos._replace(cache=topic.depth if topic.latched else 0), _HEARTBEAT_S)
