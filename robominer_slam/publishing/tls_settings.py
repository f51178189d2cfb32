"""Zenoh's settings for TLS with certificates on both sides, and for what a slow remote link carries."""

from __future__ import annotations

from collections.abc import Mapping

from robominer_slam.publishing.map_records import MAX_MESSAGE_BYTES
from robominer_slam.security.access_rules import PLAIN_PROTOCOLS
from robominer_slam.security.credentials import Credentials

#: What `status` may weigh on a remote link, bytes.
REMOTE_STATUS_BYTES = 400
#: What a message may weigh on a remote link, bytes. Updates of the map that take more are fetched (map_publisher.py).
REMOTE_BYTES = {"status": REMOTE_STATUS_BYTES, "map/updates": MAX_MESSAGE_BYTES}
#: Most messages a second of the ROS topics on a remote link. `tf_static` is sent once, and `status` has its own rule.
REMOTE_ROS_HZ = {"pose": 1.0, "odom": 0.1, "tf": 0.1, "path": 0.1, "whiskers/points": 0.1}
#: And the largest of them: 500 poses of a path would take a slow link for some seconds. Its keyframes are in the map.
REMOTE_ROS_BYTES = {"path": MAX_MESSAGE_BYTES}
#: An answer that takes a slow link longer than 5 s ends it, as Zenoh closes what has been blocked for so long, and
#: poses wait behind it: these answers have no portions, and are not carried at all where they are larger, bytes.
REMOTE_ANSWER_BYTES = 16 * 1024
WHOLE_ANSWERS = ("map/cloud", "map/grid", "map/graph")
#: A radio that is gone is noticed after 5 s instead of 10: all that waits in TLS and TCP meanwhile comes late. An
#: outage of 2 s, with TCP's pause after it, is survived. Who connects tries again soon.
_SLOW_LINK: dict[str, object] = {
    "transport/link/tx/lease": 5000,
    "connect/retry": {"period_init_ms": 500, "period_max_ms": 1000, "period_increase_factor": 2},
}
#: Likewise of their copies for ROS, where `status` is always the full one.
REMOTE_COPIES_HZ = {**REMOTE_ROS_HZ, "status": 0.1}
#: `status` goes out in full and then, at once, in short. The full one is too large for TLS links; on the others the
#: short one comes too soon after it. Full ones are a second apart.
_LOCAL_STATUS_HZ = 2.0


def tls(credentials: Credentials, *, serves: bool) -> dict[str, object]:
    """Certificates on both sides.

    Args:
        credentials: the holder's files.
        serves: whether others connect to this side, too.
    """
    values: dict[str, object] = {
        "root_ca_certificate": str(credentials.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        # Otherwise a session outlives the certificate that opened it.
        "close_link_on_expiration": True,
        "connect_certificate": str(credentials.certificate),
        "connect_private_key": str(credentials.key),
    }
    if serves:
        values["listen_certificate"] = str(credentials.certificate)
        values["listen_private_key"] = str(credentials.key)
    return {**_SLOW_LINK, **{f"transport/link/tls/{key}": value for key, value in values.items()}}


def remote_rates(prefix: str, copies: Mapping[str, str], *, remote_ros: bool) -> dict[str, object]:
    """What a TLS link carries of the messages that are made for the robot's own machine.

    Args:
        prefix: `robominer/<robot id>`.
        copies: whole keys on which ROS gets the same messages, each with the key under the prefix.
        remote_ros: leave the ROS topics at their rates.
    """
    status = f"{prefix}/status"
    downsampling: list[dict[str, object]] = [
        {
            "flows": ["egress"],
            "messages": ["put"],
            "link_protocols": list(PLAIN_PROTOCOLS),
            "rules": [{"key_expr": status, "freq": _LOCAL_STATUS_HZ}],
        }
    ]
    if not remote_ros:
        rates = {f"{prefix}/{key}": rate for key, rate in REMOTE_ROS_HZ.items()}
        rates |= {copy: REMOTE_COPIES_HZ[key] for copy, key in copies.items() if key in REMOTE_COPIES_HZ}
        rules = [{"key_expr": key, "freq": rate} for key, rate in rates.items()]
        downsampling.append({"flows": ["egress"], "messages": ["put"], "link_protocols": ["tls"], "rules": rules})
    too_large = [_too_large("put", [f"{prefix}/{key}"], limit) for key, limit in REMOTE_BYTES.items()]
    if not remote_ros:
        for key, limit in REMOTE_ROS_BYTES.items():
            same = [copy for copy, original in copies.items() if original == key]
            too_large.append(_too_large("put", [f"{prefix}/{key}", *same], limit))
        too_large.append(_too_large("reply", [f"{prefix}/{key}" for key in WHOLE_ANSWERS], REMOTE_ANSWER_BYTES))
    return {"downsampling": downsampling, "low_pass_filter": too_large}


def _too_large(kind: str, keys: list[str], limit: int) -> dict[str, object]:
    """A rule that keeps what is larger from TLS links."""
    return {
        "flows": ["egress"],
        "messages": [kind],
        "link_protocols": ["tls"],
        "key_exprs": keys,
        "size_limit": limit,
    }
