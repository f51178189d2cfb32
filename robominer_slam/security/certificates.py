"""X.509 certificates of the authority and of holders: ECDSA on P-256, which every TLS library takes.

Needs the package `cryptography`, which the robot itself does not: only who issues keys imports this.
"""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

from robominer_slam.security.access_list import Role
from robominer_slam.security.errors import KeysError

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    raise KeysError("keys need the package cryptography: pip install 'robominer-slam[keys]'") from error

AUTHORITY_DAYS = 3650
#: A board without a battery-backed clock may be behind for a while after it starts.
BACKDATED = timedelta(days=1)


class Issued(NamedTuple):
    """A certificate and its key, as PEM files have them."""

    certificate_pem: bytes
    key_pem: bytes
    serial: str
    issued: datetime
    expires: datetime


def make_authority() -> Issued:
    """A new authority, signed by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    # A part by chance tells a renewed authority from the one before.
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"robominer-slam authority {secrets.token_hex(4)}")])
    start, end = _period(AUTHORITY_DAYS)
    builder = (
        _builder(name, name, key, start, end)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
    )
    return _issued(builder.sign(key, hashes.SHA256()), key, end)


def issue(
    authority_pem: bytes, authority_key_pem: bytes, name: str, role: Role, days: int, hosts: Sequence[str]
) -> Issued:
    """A certificate for a holder.

    Args:
        authority_pem, authority_key_pem: the authority's certificate and key.
        name: becomes the common name.
        role: only a robot's certificate may serve, so that no operator's key can pose as a robot.
        days: how long it holds; never longer than the authority's.
        hosts: host names and addresses of a robot.

    Raises:
        KeysError: the authority's files are damaged or expired, or a host is none.
    """
    try:
        authority = x509.load_pem_x509_certificate(authority_pem)
        authority_key = serialization.load_pem_private_key(authority_key_pem, None)
    except (ValueError, TypeError) as error:
        raise KeysError(f"the authority's certificate or key cannot be read: {error}") from error
    if not isinstance(authority_key, ec.EllipticCurvePrivateKey):
        raise KeysError("the authority's key is not an elliptic curve's; it was not made by this program")
    start, end = _period(days)
    end = min(end, authority.not_valid_after_utc)
    if authority.not_valid_after_utc <= datetime.now(UTC):
        raise KeysError("the authority itself has expired: robominer-slam keys init --renew")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name(
        [
            x509.NameAttribute(NameOID.COMMON_NAME, name),
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role),
        ]
    )
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role == "robot":
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
    builder = (
        _builder(subject, authority.subject, key, start, end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()), critical=False)
    )
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName([_host(h) for h in hosts]), critical=False)
    return _issued(builder.sign(authority_key, hashes.SHA256()), key, end)


def _period(days: int) -> tuple[datetime, datetime]:
    now = datetime.now(UTC).replace(microsecond=0)
    return now - BACKDATED, now + timedelta(days=days)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, start: datetime, end: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(start)
        .not_valid_after(end)
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        if not host or any(c.isspace() or c in "*/:?#" for c in host):
            raise ValueError(host)
        return x509.DNSName(host)
    except ValueError as error:
        raise KeysError(f"host {host!r}: expected a host name or an address, without a port") from error


def _issued(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey, end: datetime) -> Issued:
    key_pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    pem = certificate.public_bytes(serialization.Encoding.PEM)
    now = datetime.now(UTC).replace(microsecond=0)
    return Issued(pem, key_pem, f"{certificate.serial_number:x}", now, end)
