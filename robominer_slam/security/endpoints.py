"""Which endpoints leave the machine, and which of them are protected."""

from __future__ import annotations

import ipaddress

#: Zenoh's protocols that reach no other machine whatever their address.
_IN_THE_MACHINE = ("unixsock-stream",)
_PLAIN = ("tcp", "udp", "ws")


class EndpointError(ValueError):
    """An endpoint that may not be used; the message says why."""


def is_tls(endpoint: str) -> bool:
    """Whether an endpoint is encrypted, with certificates on both sides."""
    return endpoint.startswith("tls/")


def check(endpoint: str, *, credentials: bool) -> None:
    """See that an endpoint is on loopback, or TLS with credentials.

    Args:
        endpoint: such as `tcp/127.0.0.1:7447`.
        credentials: whether keys are configured.

    Raises:
        EndpointError: it is neither, or Zenoh would not understand it.
    """
    protocol, slash, address = endpoint.partition("/")
    if not slash or not address:
        raise EndpointError(f"expected PROTOCOL/HOST:PORT, as tcp/127.0.0.1:7447, found {endpoint!r}")
    if is_tls(endpoint):
        # What follows a `#` overrides the configuration of TLS for this endpoint: no client certificate, for example.
        if "#" in endpoint or "?" in endpoint:
            raise EndpointError(f"expected tls/HOST:PORT and nothing behind it, found {endpoint!r}")
        if not credentials:
            raise EndpointError(f"expected credentials = 'FOLDER' for {endpoint!r}: keys issue makes the folder")
        return
    if protocol in _IN_THE_MACHINE:
        return
    if protocol not in _PLAIN:
        known = ", ".join((*_PLAIN, *_IN_THE_MACHINE, "tls"))
        raise EndpointError(f"expected one of the protocols {known}, found {endpoint!r}")
    if not _on_loopback(address):
        raise EndpointError(
            f"expected a loopback address, or tls/ with credentials, found {endpoint!r}: "
            "anyone who reaches it could command; make keys (robominer-slam keys), or tunnel by ssh"
        )


def _on_loopback(address: str) -> bool:
    host = address.partition("#")[0].partition("?")[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
