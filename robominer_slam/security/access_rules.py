"""Zenoh's access control from the access list: what passes a TLS link, by the name in the peer's certificate.

Whatever no rule allows is dropped. Links that are not TLS are on loopback only (`endpoints.py` sees to it), and whoever
is logged in on the robot is trusted as its own programs are: they may do everything.

Two things about Zenoh: `**` does not match chunks that start with `@`, where caches for late joiners speak, so these
are named; and a subject without names would be everybody, so a role that nobody has gets no subject at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from robominer_slam.security.access_list import AccessList, Role

#: Zenoh's protocols beside `tls`.
PLAIN_PROTOCOLS = ("tcp", "udp", "unixsock-stream", "ws")
#: Keys under the prefix that everybody on the list may read; raw sensors are for the robot's own boards.
READABLE = (
    "pose", "odom", "tf", "tf_static", "path", "whiskers/points", "status", "telemetry", "map/**",
    "map/updates/@adv/**", "tf_static/@adv/**",
)  # fmt: skip
COMMANDS = ("cmd/*",)
_ALL_MESSAGES = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
#: All keys: `**` stops at chunks that start with `@`, where histories and the announcements of ROS are.
_ANY_KEY = ("**", "**/@adv/**", "@/**", "@/*/@ros2_lv/**", "@ros2_lv/**")
#: Rules of each role.
_POLICIES: Mapping[Role, tuple[str, ...]] = {
    "robot": ("everything of the robot",),
    "operator": ("ask to look", "show", "ask to act", "acknowledge"),
    "viewer": ("ask to look", "show"),
}


def access_control(access: AccessList, prefix: str, further: Sequence[str] = ()) -> dict[str, object]:
    """The value of Zenoh's `access_control`.

    Args:
        access: who has which role.
        prefix: `robominer/<robot id>`.
        further: whole keys that everybody on the list may read as well: what ROS is shown.
    """
    readable = (*_under(prefix, READABLE), *further)
    commands = _under(prefix, COMMANDS)
    both = ("ingress", "egress")
    rules = [
        _rule("everything", both, _ALL_MESSAGES, _ANY_KEY),
        _rule("everything of the robot", both, _ALL_MESSAGES, _under(prefix, ("**", "**/@adv/**"))),
        _rule(
            "ask to look",
            ("ingress",),
            ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"),
            readable,
        ),
        _rule("show", ("egress",), ("put", "reply", "declare_queryable", "liveliness_token"), readable),
        _rule("ask to act", ("ingress",), ("query",), commands),
        _rule("acknowledge", ("egress",), ("reply", "declare_queryable"), commands),
    ]
    subjects: list[dict[str, object]] = [{"id": "local", "link_protocols": list(PLAIN_PROTOCOLS)}]
    policies: list[dict[str, object]] = [{"subjects": ["local"], "rules": ["everything"]}]
    for role, allowed in _POLICIES.items():
        names = access.names([role])
        if names:
            subjects.append({"id": role, "link_protocols": ["tls"], "cert_common_names": list(names)})
            policies.append({"subjects": [role], "rules": list(allowed)})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _under(prefix: str, keys: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{prefix}/{key}" for key in keys)


def _rule(name: str, flows: Sequence[str], messages: Sequence[str], keys: Sequence[str]) -> dict[str, object]:
    return {
        "id": name,
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": list(keys),
    }
