"""The access list: who has been given a certificate, in which role, and from whom it was taken back.

A JSON file without secrets. The authority keeps it, and every robot has a copy: Zenoh has no revocation list, so a
name that is not on the list, or is marked as revoked there, is one that the robot shows nothing and obeys in nothing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

from robominer_slam.security.errors import KeysError
from robominer_slam.security.private_files import write_file

Role: TypeAlias = Literal["robot", "operator", "viewer"]
ROLES: tuple[Role, ...] = get_args(Role)
#: What the roles may do, in words for tables and helps.
MEANING: Mapping[Role, str] = {
    "robot": "serves on TLS; another board of it may do everything",
    "operator": "may look and command",
    "viewer": "may only look",
}
#: Roles whose bearers may send commands.
COMMANDING: tuple[Role, ...] = ("operator", "robot")
FILE_NAME = "access.json"
#: A name becomes a file's name and a certificate's, and must not be able to stand for a pattern in either.
_NAME = re.compile(r"[a-z0-9](?:[a-z0-9_-]{0,61}[a-z0-9])?")
#: The authority's own files have this name.
_RESERVED = "ca"
#: A certificate that has less than this left should be renewed.
SOON_DAYS = 7


def checked_name(name: str) -> str:
    """The name, if it may be one.

    Raises:
        KeysError: it may not.
    """
    if not _NAME.fullmatch(name) or name == _RESERVED:
        raise KeysError(
            f"name {name!r}: expected 1 to 63 of a-z, 0-9, _ and -, with a letter or digit at both ends, and not 'ca'"
        )
    return name


@dataclass(frozen=True, slots=True)
class Holder:
    """Who has a certificate.

    Attributes:
        name: the certificate's common name; it is what the rules go by.
        role: what it may do.
        serial: of the newest certificate, hexadecimal.
        issued, expires: of the newest certificate, UTC, ISO 8601.
        hosts: host names and addresses under which a robot may be called.
        revoked: when it was taken back; empty: it was not.
    """

    name: str
    role: Role
    serial: str
    issued: str
    expires: str
    hosts: tuple[str, ...] = ()
    revoked: str = ""

    def state(self, now: datetime) -> str:
        """`valid`, `expires soon`, `expired` or `revoked`."""
        if self.revoked:
            return "revoked"
        left = (datetime.fromisoformat(self.expires) - now).total_seconds()
        if left <= 0:
            return "expired"
        return "expires soon" if left < SOON_DAYS * 86400 else "valid"


@dataclass(frozen=True, slots=True)
class AccessList:
    """All holders by name."""

    holders: Mapping[str, Holder]

    def names(self, roles: Iterable[Role]) -> tuple[str, ...]:
        """Who has one of these roles and was not revoked."""
        wanted = set(roles)
        return tuple(sorted(h.name for h in self.holders.values() if h.role in wanted and not h.revoked))

    def with_holder(self, holder: Holder) -> AccessList:
        """The list with a holder added or replaced."""
        return AccessList({**self.holders, holder.name: holder})

    def without(self, name: str) -> AccessList:
        """The list with a name marked as revoked."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return self.with_holder(replace(self.holders[name], revoked=now))

    def save(self, path: Path) -> None:
        """Write the list; a reader sees the old one or the new one."""
        content = {"version": 1, "holders": [asdict(self.holders[name]) for name in sorted(self.holders)]}
        write_file(path, json.dumps(content, indent=1).encode() + b"\n", private=False)


def load_access_list(path: Path) -> AccessList:
    """Read a list.

    Raises:
        KeysError: it is missing, or is none.
    """
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        holders = [_holder(entry) for entry in content["holders"]]
    except OSError as error:
        raise KeysError(f"{path}: the access list cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise KeysError(f"{path}: not an access list ({error}); copy it anew from the authority's folder") from error
    if content.get("version") != 1:
        raise KeysError(f"{path}: an access list of version {content.get('version')}; this program knows version 1")
    return AccessList({holder.name: holder for holder in holders})


def _holder(entry: Mapping[str, Any]) -> Holder:
    holder = Holder(**{**entry, "hosts": tuple(entry["hosts"])})
    checked_name(holder.name)
    if holder.role not in ROLES:
        raise ValueError(f"{holder.name}: unknown role {holder.role!r}")
    if datetime.fromisoformat(holder.expires).tzinfo is None:
        raise ValueError(f"{holder.name}: expiry without a time zone")
    if not isinstance(holder.revoked, str):
        raise ValueError(f"{holder.name}: revoked is not a text")
    return holder
