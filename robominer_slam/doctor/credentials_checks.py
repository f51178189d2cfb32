"""A holder's bundle: files, modes, dates, authority, and whether the access list has the name."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from robominer_slam.doctor.finding import Finding
from robominer_slam.security.access_list import SOON_DAYS, AccessList
from robominer_slam.security.credentials import Credentials, load_credentials
from robominer_slam.security.errors import KeysError
from robominer_slam.security.inspection import CertificateFacts, inspect
from robominer_slam.security.private_files import others_may_read


def check_credentials(folder: Path, *, robot: bool) -> Iterator[Finding]:
    """Check a bundle.

    Args:
        folder: the bundle.
        robot: it is the daemon's own: its role has to be `robot`, and it needs the access list.
    """
    try:
        credentials = load_credentials(folder)
        facts = inspect(credentials)
    except KeysError as error:
        yield Finding("credentials", "error", str(error), "copy the bundle anew from the authority's folder")
        return
    yield Finding("credentials", "ok", f"{credentials.certificate} is of the authority beside it and fits its key")
    if others_may_read(credentials.key):
        yield Finding("key", "error", f"{credentials.key} can be read by others", f"chmod 600 {credentials.key}")
    yield _dates(facts)
    if robot:
        yield from _robot(credentials, facts)


def role_of(folder: Path) -> str:
    """The role in a bundle's certificate; empty where it cannot be told."""
    try:
        return inspect(load_credentials(folder)).role
    except KeysError:
        return ""


def renewal(facts: CertificateFacts) -> str:
    """The command that makes a new certificate."""
    return f"robominer-slam keys issue {facts.name} --role {facts.role} --replace"


def _dates(facts: CertificateFacts) -> Finding:
    now = datetime.now(UTC)
    if now < facts.starts:
        text = f"valid only from {facts.starts:%Y-%m-%d %H:%M} UTC, and it is {now:%Y-%m-%d %H:%M} by this clock"
        return Finding("certificate", "error", text, "set this machine's clock")
    left_days = (facts.ends - now).total_seconds() / 86400
    if left_days <= 0:
        text = f"the certificate of {facts.name} expired at {facts.ends:%Y-%m-%d %H:%M} UTC"
        return Finding("certificate", "error", text, renewal(facts))
    until = f"the certificate of {facts.name} ({facts.role}) is valid until {facts.ends:%Y-%m-%d %H:%M} UTC"
    if left_days < SOON_DAYS:
        return Finding("certificate", "warning", f"{until}: {left_days:.1f} days", renewal(facts))
    return Finding("certificate", "ok", until)


def _robot(credentials: Credentials, facts: CertificateFacts) -> Iterator[Finding]:
    if facts.role != "robot":
        text = f"the certificate is a {facts.role or 'stranger'}'s, and cannot serve"
        yield Finding("role", "error", text, "robominer-slam keys issue NAME --role robot --host HOST")
    try:
        access = credentials.access_list()
    except KeysError as error:
        yield Finding("access list", "error", str(error), "copy access.json from the authority's folder")
        return
    yield _on_list(access, facts.name)
    operators, viewers = access.names(["operator"]), access.names(["viewer"])
    text = f"operators: {', '.join(operators) or 'none'}; viewers: {', '.join(viewers) or 'none'}"
    if operators or viewers:
        yield Finding("access list", "ok", text)
    else:
        mend = "robominer-slam keys issue NAME --role operator, and copy access.json here"
        yield Finding("access list", "warning", f"{text}: nobody can look or command by TLS", mend)


def _on_list(access: AccessList, name: str) -> Finding:
    holder = access.holders.get(name)
    mend = "robominer-slam keys issue NAME --role robot, under a name that was never revoked"
    if holder is None:
        return Finding("name", "error", f"{name} is not on the access list", "copy access.json anew")
    if holder.revoked:
        return Finding("name", "error", f"{name} was revoked at {holder.revoked}", mend)
    return Finding("name", "ok", f"{name} is on the access list as {holder.role}")
