"""How a client joins: `status`, `doctor`, the operator's console, and whatever else connects to a daemon."""

from __future__ import annotations

from pathlib import Path

from robominer_slam.publishing.tls_settings import tls
from robominer_slam.publishing.zenoh_settings import ZenohSettings, ZenohSetupError
from robominer_slam.security.credentials import load_credentials
from robominer_slam.security.endpoints import is_tls


def client_settings(connect: str, credentials: Path | None = None, timeout_s: float | None = None) -> ZenohSettings:
    """Settings of a client.

    Args:
        connect: the daemon's endpoint, such as `tcp/127.0.0.1:7447` or `tls/robot:7447`.
        credentials: folder with the holder's bundle, for TLS.
        timeout_s: how long opening waits for the daemon; None: fails at once.

    Raises:
        ZenohSetupError: TLS without credentials.
        KeysError: credentials that are none.
    """
    if is_tls(connect) and credentials is None:
        raise ZenohSetupError(f"{connect}: expected --credentials FOLDER, the bundle that keys issue has made for you")
    further = tls(load_credentials(credentials), serves=False) if credentials is not None else {}
    return ZenohSettings(connect=(connect,), mode="client", connect_timeout_s=timeout_s, further=further)
