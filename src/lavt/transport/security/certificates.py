"""A test certificate authority, router certificates (X.509, EC P-256) and signing keys (Ed25519).

Everything is PEM: certificates, private keys as PKCS 8 without a password, public keys as SubjectPublicKeyInfo.
Zenoh's access lists match the common name (CN) of a certificate. Only certificates of routers that accept connections
contain host addresses and the server usage, so a thief of an operator's key cannot impersonate the vehicle's router.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final, TypeVar

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, EllipticCurvePrivateKey, generate_private_key
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from msgspec import Struct

from lavt.clock import calendar_time
from lavt.domain import NS_PER_S
from lavt.errors import UserError
from lavt.transport.security.keys import NS_PER_DAY, expiry_line

CLOCK_SKEW_NS: Final = NS_PER_DAY
"""Certificates are already valid this long before they are made, because the clock of a vehicle that has just started
can be behind."""
AUTHORITY: Final = "lavt test authority"
LOOPBACK: Final = ("127.0.0.1", "localhost")
_LABEL: Final = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST: Final = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(\.{_LABEL})*\Z")
Kind = TypeVar("Kind", bound=x509.ExtensionType)


class KeyPair(Struct, frozen=True):
    """A private key and its public part, which is a certificate or a public key. Both are PEM."""

    private: bytes
    public: bytes


class CertificateSummary(Struct, frozen=True):
    """The fields of a certificate that `lavt keys` prints."""

    name: str
    role: str
    hosts: tuple[str, ...]
    """Names and addresses at which the server accepts connections; empty for a client."""
    expires: str
    """The day in UTC, such as 2027-01-31."""


def new_authority(now_wall_ns: int, days: int) -> KeyPair:
    """Create a self-signed authority, valid for `days`. It can sign certificates, but no other authority."""
    key = generate_private_key(SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, AUTHORITY)])
    builder = (
        _builder(name, name, key, now_wall_ns)
        .not_valid_after(calendar_time(now_wall_ns + days * NS_PER_DAY))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(authority=True), critical=True)
    )
    return KeyPair(_private_pem(key), _certificate_pem(builder.sign(key, hashes.SHA256())))


def new_certificate(
    authority: KeyPair, name: str, role: str, *, server_hosts: Iterable[str] | None, now_wall_ns: int, days: int
) -> KeyPair:
    """Create a key and a certificate whose CN is `name` and whose organizational unit (OU) is `role`.

    `server_hosts` are the addresses and host names besides the loopback ones; None makes a client-only certificate.
    The certificate is valid for `days`, but not longer than the authority's. Raise `UserError` for an authority that
    cannot be read or has expired.
    """
    issuer, issuer_key = _load_authority(authority)
    begins, ends = calendar_time(now_wall_ns), issuer.not_valid_after_utc
    if ends <= begins:
        raise UserError(f"the authority expired on {_expiry_day(issuer)}: make a new one, in another directory")
    key = generate_private_key(SECP256R1())
    subject = x509.Name(
        [x509.NameAttribute(NameOID.COMMON_NAME, name), x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role)]
    )
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH] + ([] if server_hosts is None else [ExtendedKeyUsageOID.SERVER_AUTH])
    hosts = [name] if server_hosts is None else [name, *LOOPBACK, *server_hosts]
    builder = (
        _builder(subject, issuer.subject, key, now_wall_ns)
        .not_valid_after(min(calendar_time(now_wall_ns + days * NS_PER_DAY), ends))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(
            x509.SubjectAlternativeName([_general_name(host) for host in dict.fromkeys(hosts)]), critical=False
        )
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key()), critical=False)
    )
    return KeyPair(_private_pem(key), _certificate_pem(builder.sign(issuer_key, hashes.SHA256())))


def new_signing_pair(now_wall_ns: int, days: int) -> KeyPair:
    """Create an Ed25519 key pair for signatures, valid for `days`; the expiry is in the line before either key."""
    key = Ed25519PrivateKey.generate()
    public = key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    line = expiry_line(now_wall_ns + days * NS_PER_DAY)
    return KeyPair(line + _private_pem(key), line + public)


def summarize(certificate: bytes, where: str) -> CertificateSummary:
    """Return the summary of a PEM certificate; `where` describes its place in the `UserError` for an invalid one."""
    parsed = _load_certificate(certificate, where)
    usages = _extension(parsed, x509.ExtendedKeyUsage)
    is_server = usages is not None and ExtendedKeyUsageOID.SERVER_AUTH in usages
    names = _extension(parsed, x509.SubjectAlternativeName) if is_server else None
    return CertificateSummary(
        name=_subject(parsed, NameOID.COMMON_NAME),
        role=_subject(parsed, NameOID.ORGANIZATIONAL_UNIT_NAME),
        hosts=tuple(str(name.value) for name in names or ()),
        expires=_expiry_day(parsed),
    )


def days_left(certificate: bytes, where: str, now_wall_ns: int) -> float:
    """Return the days until a certificate expires, negative after that; raise `UserError` as `summarize` does."""
    return (
        _load_certificate(certificate, where).not_valid_after_utc.timestamp() * NS_PER_S / NS_PER_DAY
        - now_wall_ns / NS_PER_DAY
    )


def check_expiry(path: Path, now_wall_ns: int) -> None:
    """Raise `UserError` for a certificate that has expired, or that is not one."""
    data = path.read_bytes()
    if days_left(data, str(path), now_wall_ns) <= 0:
        day = summarize(data, str(path)).expires
        raise UserError(f"the certificate {path} expired on {day}: make new keys with `lavt keys DIR`")


def is_host(text: str) -> bool:
    """Return whether `text` is an IP address or a host name without a port."""
    return _address(text) is not None or _HOST.match(text) is not None


def _builder(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePrivateKey, now_wall_ns: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(calendar_time(now_wall_ns - CLOCK_SKEW_NS))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _key_usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _general_name(host: str) -> x509.GeneralName:
    address = _address(host)
    return x509.DNSName(host) if address is None else x509.IPAddress(address)


def _private_pem(key: EllipticCurvePrivateKey | Ed25519PrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _certificate_pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _load_certificate(certificate: bytes, where: str) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(certificate)
    except ValueError as error:
        raise UserError(f"{where} is not a PEM certificate: copy it back, or move it away") from error


def _load_authority(authority: KeyPair) -> tuple[x509.Certificate, EllipticCurvePrivateKey]:
    certificate = _load_certificate(authority.public, "the authority's certificate")
    try:
        key = serialization.load_pem_private_key(authority.private, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise UserError("the authority's key is not a PEM private key without a password: copy it back") from error
    if not isinstance(key, EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise UserError("the authority's key does not match its certificate: copy both back")
    return certificate, key


def _expiry_day(certificate: x509.Certificate) -> str:
    return certificate.not_valid_after_utc.strftime("%Y-%m-%d")


def _subject(certificate: x509.Certificate, part: x509.ObjectIdentifier) -> str:
    return next((str(attribute.value) for attribute in certificate.subject.get_attributes_for_oid(part)), "")


def _extension(certificate: x509.Certificate, kind: type[Kind]) -> Kind | None:
    try:
        return certificate.extensions.get_extension_for_class(kind).value
    except x509.ExtensionNotFound:
        return None
