"""Zenoh's settings for TLS with certificates on both sides, and for what a slow remote link carries."""

from __future__ import annotations

from collections.abc import Mapping

from robominer_slam.security.access_rules import PLAIN_PROTOCOLS
from robominer_slam.security.credentials import Credentials

#: What `status` may weigh on a remote link, bytes.
REMOTE_STATUS_BYTES = 400
#: Most messages a second of the ROS topics on a remote link. `tf_static` is sent once, and `status` has its own rule.
REMOTE_ROS_HZ = {"pose": 1.0, "odom": 0.1, "tf": 0.1, "path": 0.1, "whiskers/points": 0.1}
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
    return {f"transport/link/tls/{key}": value for key, value in values.items()}


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
    too_large = {
        "flows": ["egress"],
        "messages": ["put"],
        "link_protocols": ["tls"],
        "key_exprs": [status],
        "size_limit": REMOTE_STATUS_BYTES,
    }
    return {"downsampling": downsampling, "low_pass_filter": [too_large]}
