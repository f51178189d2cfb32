"""A TLS handshake with the robot by Python's own library, to learn why Zenoh, which only times out, is refused."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Iterator

from robominer_slam.doctor.finding import Finding
from robominer_slam.security.credentials import Credentials

#: With TLS 1.3 the server judges the client's certificate after the client has finished: its verdict comes a moment
#: later, and from a content server nothing comes.
VERDICT_S = 2.0
#: OpenSSL's X509_V_ERR_... for what the server has shown.
_NOT_YET_VALID, _EXPIRED = 9, 10
_PURPOSE = 26
_HOST, _ADDRESS = 62, 64
#: What the server said of the client's certificate, by OpenSSL's names of the alerts.
_ALERTS = {
    "CERTIFICATE_REQUIRED": ("the robot asks for a certificate, and got none", "give --credentials FOLDER"),
    "CERTIFICATE_EXPIRED": (
        "the robot refuses your certificate: expired",
        "robominer-slam keys issue NAME --role ROLE --replace",
    ),
    "UNKNOWN_CA": (
        "the robot refuses your certificate: of an authority that it does not know",
        "copy your new bundle from the authority of this robot",
    ),
    "BAD_CERTIFICATE": ("the robot refuses your certificate", "copy your bundle anew from the authority's folder"),
    "DECRYPT_ERROR": ("the robot refuses your certificate", "copy your bundle anew from the authority's folder"),
    "CERTIFICATE_UNKNOWN": ("the robot refuses your certificate", "copy your bundle anew from the authority's folder"),
}


def reach(host: str, port: int, timeout_s: float) -> tuple[socket.socket | None, Finding]:
    """Connect, and say what stands in the way."""
    place = f"{host}:{port}"
    try:
        connection = socket.create_connection((host, port), timeout=timeout_s)
    except socket.gaierror:
        return None, Finding("network", "error", f"no machine has the name {host}", "check the name, or use an address")
    except ConnectionRefusedError:
        mend = "start the daemon, and see its [zenoh] listen; a firewall may refuse, too"
        return None, Finding("network", "error", f"{place}: the machine is there, the port is closed", mend)
    except OSError as error:
        reason = "no answer" if isinstance(error, TimeoutError) else error.strerror or str(error)
        return None, Finding("network", "error", f"{place}: {reason}", f"check the link: ping {host}")
    return connection, Finding("network", "ok", f"{place} takes connections")


def probe(connection: socket.socket, host: str, credentials: Credentials | None) -> Iterator[Finding]:
    """Shake hands, and wait for the robot's verdict; the connection is closed."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if credentials is None:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    else:
        context.load_verify_locations(cafile=credentials.authority)
        context.load_cert_chain(credentials.certificate, credentials.key)
    try:
        with context.wrap_socket(connection, server_hostname=host) as link:
            link.settimeout(VERDICT_S)
            try:
                # Empty: the robot hung up without a word.
                taken = bool(link.recv(1))
            except TimeoutError:
                taken = True
    except ssl.SSLCertVerificationError as error:
        yield _server(error, host)
    except ssl.SSLError as error:
        yield _alert(error)
    except OSError as error:
        yield Finding("TLS", "error", f"the link broke while shaking hands: {error}", "is it a robominer-slam daemon?")
    else:
        if taken:
            yield Finding("TLS", "ok", "robot and certificate accept each other")
        else:
            yield Finding("TLS", "error", "the robot hung up after the handshake", "look into the robot's log")
    finally:
        connection.close()


def _server(error: ssl.SSLCertVerificationError, host: str) -> Finding:
    code = error.verify_code
    if code in (_HOST, _ADDRESS):
        mend = f"robominer-slam keys issue ROBOT --role robot --host {host} --replace, and copy the bundle to it"
        return Finding("TLS", "error", f"the robot's certificate is not for the name {host}", mend)
    if code == _EXPIRED:
        mend = "robominer-slam keys issue ROBOT --role robot --replace, and copy the bundle to it"
        return Finding("TLS", "error", "the robot's certificate has expired", mend)
    if code == _NOT_YET_VALID:
        return Finding("TLS", "error", "the robot's certificate is not valid yet", "set this machine's clock")
    if code == _PURPOSE:
        mend = "do not trust it; robots have certificates of the role robot"
        return Finding("TLS", "error", "who answers there has no robot's certificate", mend)
    text = f"the robot is of another authority than your bundle ({error.verify_message})"
    return Finding("TLS", "error", text, "copy bundles of one authority to both machines")


def _alert(error: ssl.SSLError) -> Finding:
    reason = error.reason or str(error)
    for name, (text, mend) in _ALERTS.items():
        if reason.endswith(f"ALERT_{name}"):
            return Finding("TLS", "error", text, mend)
    if reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "UNEXPECTED_EOF_WHILE_READING"):
        mend = "connect to the port of the robot's tls/ endpoint; tcp/ is for loopback"
        return Finding("TLS", "error", "what answers there does not speak TLS", mend)
    return Finding("TLS", "error", f"the handshake failed: {reason}", "look into the robot's log")
