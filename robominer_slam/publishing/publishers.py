"""Publishers as their keys' quality of service asks for them: plain ones, or with a cache for those who come later."""

from __future__ import annotations

from typing import TypeAlias

import zenoh
from zenoh import ext

from robominer_slam.publishing.keys import Qos

Publisher: TypeAlias = zenoh.Publisher | ext.AdvancedPublisher

#: Whoever keeps a cache says this often, if something was sent, up to where it has sent, s.
MISS_HEARTBEAT_S = 1.0


def declare(session: zenoh.Session, key: str, qos: Qos, heartbeat_s: float = MISS_HEARTBEAT_S) -> Publisher:
    """A publisher of a whole key; one with a cache says so often up to where it has sent, s."""
    if qos.cache == 0:
        return session.declare_publisher(
            key, priority=qos.priority, congestion_control=qos.congestion, express=qos.express
        )
    return ext.declare_advanced_publisher(
        session,
        key,
        priority=qos.priority,
        congestion_control=qos.congestion,
        express=qos.express,
        cache=ext.CacheConfig(qos.cache),
        sample_miss_detection=ext.MissDetectionConfig(sporadic_heartbeat=heartbeat_s, heartbeat=None),
        publisher_detection=True,
    )


def somebody_listens(publisher: Publisher, *, unknown: bool) -> bool:
    """Whether there is a subscriber; `unknown` where the publisher cannot tell, as those with a history."""
    if not isinstance(publisher, zenoh.Publisher):
        return unknown
    # Zenoh's stubs declare the status as a plain bool.
    status: object = publisher.matching_status
    return bool(getattr(status, "matching", status))
