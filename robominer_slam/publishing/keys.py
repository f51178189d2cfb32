"""The Zenoh keys under `robominer/<robot id>`: what each carries and how it is to travel.

Quality of service, and why:

- pose, odom, tf: small, only the newest counts. Real-time priority, dropped when the link is full, sent at once.
- telemetry: the same for remote links, behind the poses where both go.
- map/updates: every message counts, but waiting is worse: a publisher that blocks waits up to 5 s and then loses
  the link for everything else. So it is dropped when the link is full, in messages of a few KB, and what was lost
  is fetched by queries (map_receiver.py), or had again from the publisher's cache.
- answers about the map: behind everything else, and not dropped; large ones only on fast links, or in portions.
- tf_static: latched; a cache of one message for late joiners.
"""

from __future__ import annotations

from typing import NamedTuple

import zenoh

from robominer_slam.publishing.cloud_messages import POINT_CLOUD
from robominer_slam.publishing.pose_messages import ODOMETRY, PATH, POSE_WITH_COVARIANCE, TF_MESSAGE
from robominer_slam.publishing.report_messages import DIAGNOSTIC_ARRAY, OCCUPANCY_GRID

CDR = "application/cdr"
JSON = "application/json"
TELEMETRY = "application/octet-stream;robominer_slam/telemetry"
MAP_STREAM = "application/octet-stream;robominer_slam/map_stream"

_ENCODINGS = {
    "pose": f"{CDR};{POSE_WITH_COVARIANCE}",
    "odom": f"{CDR};{ODOMETRY}",
    "tf": f"{CDR};{TF_MESSAGE}",
    "tf_static": f"{CDR};{TF_MESSAGE}",
    "path": f"{CDR};{PATH}",
    "whiskers/points": f"{CDR};{POINT_CLOUD}",
    "status": f"{CDR};{DIAGNOSTIC_ARRAY}",
    "map/updates": MAP_STREAM,
    "map/snapshot": MAP_STREAM,
    "map/cloud": f"{CDR};{POINT_CLOUD}",
    "map/grid": f"{CDR};{OCCUPANCY_GRID}",
    "map/graph": JSON,
    "map/closures": JSON,
    "map/saved": MAP_STREAM,
    "telemetry": TELEMETRY,
}


class Qos(NamedTuple):
    """How a key's messages travel.

    Attributes:
        priority: which goes first where a link is full.
        congestion: what happens to a message that a full link does not take.
        express: sent at once, not gathered with others.
        cache: messages kept for late joiners and for those who missed some; 0: a plain publisher.
    """

    priority: zenoh.Priority = zenoh.Priority.DATA
    congestion: zenoh.CongestionControl = zenoh.CongestionControl.DROP
    express: bool = False
    cache: int = 0


_POSES = Qos(zenoh.Priority.REAL_TIME, express=True)
#: A large answer waits for everything else, and is not cut by a full link.
_ANSWER = Qos(zenoh.Priority.DATA_LOW, zenoh.CongestionControl.BLOCK)
_QOS = {
    "pose": _POSES,
    "odom": _POSES,
    "tf": _POSES,
    "tf_static": Qos(zenoh.Priority.DATA_HIGH, cache=1),
    "telemetry": Qos(zenoh.Priority.INTERACTIVE_HIGH, express=True),
    "whiskers/points": Qos(zenoh.Priority.INTERACTIVE_LOW),
    "status": Qos(zenoh.Priority.DATA_HIGH),
    "path": Qos(zenoh.Priority.DATA_LOW),
    "map/updates": Qos(zenoh.Priority.DATA_LOW, cache=256),
}
#: Raw sensors for a board that does the SLAM: late ones are of no use to it.
_RAW = Qos(zenoh.Priority.INTERACTIVE_HIGH, express=True)


def cdr(typename: str) -> str:
    """The encoding of a ROS message of this type."""
    return f"{CDR};{typename}"


def encoding_of(key: str) -> str:
    """The encoding of a key under the prefix.

    Raises:
        KeyError: a key that has no encoding of its own (`raw/<device>`).
    """
    if key.startswith("cmd/"):
        return JSON
    return _ENCODINGS[key]


def qos_of(key: str) -> Qos:
    """How messages of a key under the prefix travel."""
    if key.startswith("raw/"):
        return _RAW
    return _QOS.get(key, Qos())


def qos_of_query(key: str) -> Qos:
    """How queries of a key travel, and their answers with them."""
    return _ANSWER if key.startswith("map/") else Qos(zenoh.Priority.DATA_HIGH, zenoh.CongestionControl.BLOCK)
