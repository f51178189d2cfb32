"""The connection to a daemon: network, TLS, Zenoh, and what the robot lets this holder do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from robominer_slam.doctor.credentials_checks import role_of
from robominer_slam.doctor.finding import Finding
from robominer_slam.doctor.tls_probe import probe, reach
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSetupError
from robominer_slam.security.access_list import COMMANDING
from robominer_slam.security.credentials import load_credentials
from robominer_slam.security.endpoints import is_tls
from robominer_slam.security.errors import KeysError

#: What the robot offers it says as soon as the link stands; a slow link takes a moment.
OFFER_S = 3.0
#: What it offers comes together: after the first, the second is there or will not come.
NEXT_OFFER_S = 1.0


def check_link(connect: str, credentials: Path | None, prefix: str, timeout_s: float) -> Iterator[Finding]:
    """Check a connection, step by step; what cannot be reached ends it.

    Args:
        connect: endpoint, `tcp/HOST:PORT` or `tls/HOST:PORT`.
        credentials: the holder's bundle.
        prefix: `robominer/<robot id>`.
        timeout_s: for each step.
    """
    host, port = _address(connect)
    if port is None:
        yield Finding("network", "error", f"{connect}: expected tcp/HOST:PORT or tls/HOST:PORT", "mend --connect")
        return
    connection, finding = reach(host, port, timeout_s)
    yield finding
    if connection is None:
        return
    if is_tls(connect):
        try:
            bundle = None if credentials is None else load_credentials(credentials)
            findings = list(probe(connection, host, bundle))
        # Whatever is wrong with the bundle has been said by the checks of the credentials.
        except (KeysError, OSError):
            connection.close()
            return
        yield from findings
        if any(finding.level == "error" for finding in findings):
            return
    else:
        connection.close()
    yield from _zenoh(connect, credentials, prefix, timeout_s)


def _zenoh(connect: str, credentials: Path | None, prefix: str, timeout_s: float) -> Iterator[Finding]:
    try:
        with ZenohBus(client_settings(connect, credentials, timeout_s), prefix) as bus:
            yield Finding("Zenoh", "ok", "connected")
            reads = bus.answered("map/snapshot", OFFER_S)
            commands = bus.answered("cmd/pause", NEXT_OFFER_S if reads else 0.0)
    except (ZenohSetupError, KeysError) as error:
        yield Finding("Zenoh", "error", str(error), "is it a robominer-slam daemon?")
        return
    if not reads:
        text = f"connected, but shown nothing under {prefix}: revoked, not on the robot's access list, or another id"
        mend = "robominer-slam keys list; copy access.json to the robot and start its daemon anew; check --robot"
        yield Finding("access", "error", text, mend)
        return
    role = "operator" if credentials is None else role_of(credentials)
    if commands:
        yield Finding("access", "ok", "may look and command")
    elif role in COMMANDING:
        text = f"may look, but not command, though the certificate is an {role}'s"
        yield Finding("access", "error", text, "copy access.json to the robot and start its daemon anew")
    else:
        yield Finding("access", "ok", "may look, not command, as a viewer")


def _address(endpoint: str) -> tuple[str, int | None]:
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    good = protocol in ("tcp", "tls") and host and port.isdecimal() and 0 < int(port) < 65536
    return host.strip("[]"), int(port) if good else None
