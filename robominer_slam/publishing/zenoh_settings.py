"""A Zenoh session from plain settings, closed to everything that was not asked for."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import zenoh

from robominer_slam.publishing.ros_bridge import RosSettings

#: Zenoh's own default is 1 GiB, for anyone who can reach the port.
MAX_MESSAGE_BYTES = 1 << 20
#: A lost link is tried again after one second, then at most every two.
_RETRY_MS = {"period_init_ms": 1000, "period_max_ms": 2000, "period_increase_factor": 2}
#: Zenoh's errors end with the place in its own sources.
_SOURCE_PLACE = re.compile(r"\s*\bat /\S+?\.rs:\d+\.?")


class ZenohSetupError(Exception):
    """A session that cannot be opened; the message is one line: what, where, what to do."""


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """How to join the network.

    Attributes:
        listen: endpoints to listen on, such as `tcp/127.0.0.1:7447`; none: no listening.
        connect: endpoints to connect to.
        mode: robots are peers; a console is a client (peers do not relay for each other, but do for clients).
        max_message_bytes: larger messages are refused on receiving.
        connect_timeout_s: how long opening waits for a connection: None: a peer goes on and keeps trying, a
            client fails at once.
        remote: whether TLS links are to be served, with their short `status`.
        commanders: names in certificates whose holders may send commands.
        ros: who in ROS is to see the topics; None: nobody.
        further: more of Zenoh's configuration, path to value, such as TLS and access control.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    mode: Literal["peer", "client"] = "peer"
    max_message_bytes: int = MAX_MESSAGE_BYTES
    connect_timeout_s: float | None = None
    remote: bool = False
    commanders: tuple[str, ...] = ()
    ros: RosSettings | None = None
    further: Mapping[str, object] = field(default_factory=dict)


def configuration(settings: ZenohSettings) -> zenoh.Config:
    """The settings as Zenoh's configuration.

    Raises:
        ZenohSetupError: Zenoh does not take a value.
    """
    values: dict[str, object] = {
        "mode": settings.mode,
        "listen/endpoints": settings.listen,
        "connect/endpoints": settings.connect,
        "connect/retry": _RETRY_MS,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Costs a publisher 25 MB, and leaves files in /dev/shm when killed.
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": settings.max_message_bytes,
        # Caches for late joiners need time stamps.
        "timestamping/enabled": {"router": True, "peer": True, "client": True},
    }
    if settings.connect_timeout_s is not None:
        values["connect/timeout_ms"] = round(settings.connect_timeout_s * 1000.0)
        values["connect/exit_on_failure"] = True
    values.update(settings.further)
    config = zenoh.Config()
    for path, value in values.items():
        try:
            config.insert_json5(path, json.dumps(value))
        except zenoh.ZError as error:
            raise ZenohSetupError(f"[zenoh] {path} = {json.dumps(value)}: {_reason(error)}") from error
    return config


def open_session(settings: ZenohSettings) -> zenoh.Session:
    """Open a session; close it, or the process may hang at its end.

    Raises:
        ZenohSetupError: an endpoint that cannot be listened on or connected to.
    """
    config = configuration(settings)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = _reason(error)
    if settings.mode == "client":
        where = ", ".join(settings.connect) or "nothing"
        if any(endpoint.startswith("tls/") for endpoint in settings.connect):
            # Zenoh does not tell a refused certificate from a robot that is not there.
            hint = "ask `robominer-slam doctor --connect ENDPOINT --credentials FOLDER` why"
        else:
            hint = "is the robot's program running?"
        raise ZenohSetupError(f"[zenoh] cannot connect to {where}: {reason}; {hint}")
    if "ddress already in use" in reason:
        where = ", ".join(settings.listen)
        raise ZenohSetupError(f"[zenoh] listen {where}: another program listens there; is the daemon running already?")
    where = f"listen {', '.join(settings.listen) or 'nothing'}, connect {', '.join(settings.connect) or 'nothing'}"
    raise ZenohSetupError(f"[zenoh] {where}: {reason}")


def _reason(error: zenoh.ZError) -> str:
    message = _SOURCE_PLACE.sub("", str(error))
    if wrapped := re.search(r'msg: "(.*?)"', message):
        message = wrapped[1]
    return " ".join(message.split()).rstrip(" .!")
