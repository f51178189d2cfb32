"""What a holder's certificate says and whether it is any good, by a handshake of the bundle with itself, in memory.

Python's `ssl` verifies exactly as a peer on the network does, and reads dates and names; so the robot needs no
package for it.
"""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from datetime import UTC, datetime

from robominer_slam.security.credentials import Credentials
from robominer_slam.security.errors import KeysError

#: X509_V_FLAG_NO_CHECK_TIME of OpenSSL: read dates also of a certificate that has expired.
_NO_CHECK_TIME = 0x200000


@dataclass(frozen=True, slots=True)
class CertificateFacts:
    """What a certificate says, once it is known to come from the authority beside it.

    Attributes:
        name: common name.
        role: as the authority wrote it; empty where it wrote none.
        starts, ends: UTC.
        hosts: host names and addresses that it may serve under.
    """

    name: str
    role: str
    starts: datetime
    ends: datetime
    hosts: tuple[str, ...]


def inspect(credentials: Credentials) -> CertificateFacts:
    """Read a holder's certificate and check it against its key and its authority; not its dates.

    Raises:
        KeysError: files that are no certificates, a key of another certificate, a foreign authority.
    """
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    client.verify_mode = ssl.CERT_NONE
    server.verify_mode = ssl.CERT_REQUIRED
    server.verify_flags |= ssl.VerifyFlags(_NO_CHECK_TIME)
    try:
        server.load_verify_locations(cafile=credentials.authority)
    except ssl.SSLError as error:
        raise KeysError(f"{credentials.authority}: not a certificate") from error
    try:
        for context in (server, client):
            context.load_cert_chain(credentials.certificate, credentials.key)
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise KeysError(
                f"{credentials.key}: is the key of another certificate than {credentials.certificate.name}"
            ) from error
        raise KeysError(
            f"{credentials.certificate} or {credentials.key.name}: not a certificate and its key"
        ) from error
    try:
        content = _handshake(server, client)
    except ssl.SSLCertVerificationError as error:
        raise KeysError(
            f"{credentials.certificate}: not issued by {credentials.authority.name} beside it ({error.verify_message})"
        ) from error
    except ssl.SSLError as error:
        raise KeysError(f"{credentials.certificate}: cannot be used: {error.reason}") from error
    return _facts(content)


def _handshake(server_context: ssl.SSLContext, client_context: ssl.SSLContext) -> dict[str, object]:
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    server = server_context.wrap_bio(to_server, to_client, server_side=True)
    client = client_context.wrap_bio(to_client, to_server)
    done = [False, False]
    # Each side waits for the other once or twice; more would be a handshake that never ends.
    for _ in range(10):
        for i, side in enumerate((client, server)):
            if not done[i]:
                try:
                    side.do_handshake()
                    done[i] = True
                except ssl.SSLWantReadError:
                    continue
        if all(done):
            break
    found = server.getpeercert()
    if not found:
        raise ssl.SSLError("the handshake did not end")
    return dict(found)


def _facts(content: dict[str, object]) -> CertificateFacts:
    subject: dict[str, str] = {}
    parts = content.get("subject")
    for part in parts if isinstance(parts, tuple) else ():
        subject.update(part)
    names = content.get("subjectAltName")
    hosts = tuple(str(value) for _, value in names) if isinstance(names, tuple) else ()
    return CertificateFacts(
        subject.get("commonName", ""),
        subject.get("organizationalUnitName", ""),
        _time(content["notBefore"]),
        _time(content["notAfter"]),
        hosts,
    )


def _time(text: object) -> datetime:
    return datetime.fromtimestamp(ssl.cert_time_to_seconds(str(text)), UTC)
