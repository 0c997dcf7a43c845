"""Signing keys (Ed25519), key agreement (X25519, HKDF) and encryption (AES-GCM).

Only this module and `certificates.py` import `cryptography`. The package is an extra, so functions import it when they
need it.
"""

from __future__ import annotations

import re
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lavt.clock import calendar_time
from lavt.domain import NS_PER_S
from lavt.errors import UserError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SIGNATURE_BYTES: Final = 64
PUBLIC_KEY_BYTES: Final = 32
NONCE_BYTES: Final = 12
SECRET_BYTES: Final = 32
NS_PER_DAY: Final = 86_400 * NS_PER_S

_EXPIRY: Final = b"LAVT signing key 1, expires "
"""The beginning of the line before a PEM key, where a PEM file may have any text (RFC 7468); 1 is the version."""
_EXPIRY_LINE: Final = re.compile(rb"%s(\d{1,11}) " % _EXPIRY)
_PEM_BLOCK: Final = re.compile(rb"-----BEGIN .*?-----END [^-\n]*-----", re.DOTALL)
_INSTALL: Final = "signing needs the package cryptography: pip install -e '.[secure]' in the clone"


class PrivateKey:
    """An Ed25519 key that signs (RFC 8032)."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key

    def sign(self, data: bytes) -> bytes:
        """Return the signature of `data`, 64 bytes."""
        return self._key.sign(data)

    @property
    def public(self) -> PublicKey:
        """The public key that verifies this key's signatures."""
        return PublicKey(self._key.public_key())


class PublicKey:
    """An Ed25519 key that verifies signatures."""

    def __init__(self, key: Ed25519PublicKey) -> None:
        self._key = key

    def verify(self, signature: bytes, data: bytes) -> bool:
        """Return whether `signature` is a valid signature of `data`; a malformed signature is not valid."""
        from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 (an extra)

        try:
            self._key.verify(signature, data)
        except InvalidSignature:
            return False
        return True


def expiry_line(expires_wall_ns: int) -> bytes:
    """Return the line before a PEM key with the time when the key expires: seconds of Unix time, and the day in UTC."""
    return _EXPIRY + f"{expires_wall_ns // NS_PER_S} ({calendar_time(expires_wall_ns):%Y-%m-%d})\n".encode()


def key_expiry_ns(data: bytes, path: Path) -> int | None:
    """Return the wall clock time at which a key expires; None for a key without an expiry.

    `data` is the content of the file `path`. Raise `UserError` for text outside of the key that is not an expiry,
    because it may be one with a typo.
    """
    text = _PEM_BLOCK.sub(b"", data).strip()
    if not text:
        return None
    found = _EXPIRY_LINE.match(text)
    expires_ns = int(found[1]) * NS_PER_S if found is not None else 0
    if text != expiry_line(expires_ns).strip():
        raise UserError(
            f"the text outside of the key in {path} is not an expiry: copy the file again, or make new keys; remove "
            "the text only if another program has written it"
        )
    return expires_ns


def _check_expiry(data: bytes, path: Path, now_wall_ns: int | None) -> None:
    """Raise `UserError` for a key that has expired by `now_wall_ns`; None: the expiry is not read."""
    if now_wall_ns is None:
        return
    expires_ns = key_expiry_ns(data, path)
    if expires_ns is not None and now_wall_ns >= expires_ns:
        day = calendar_time(expires_ns).strftime("%Y-%m-%d")
        raise UserError(f"the key {path} expired on {day}: make new keys with `lavt keys DIR`")


def load_private(path: Path, now_wall_ns: int | None = None) -> PrivateKey:
    """Read an Ed25519 private key (PEM, PKCS 8).

    Raise `UserError` if it is invalid, if other users may read it, or if it has expired by `now_wall_ns`.
    """
    data = _read(path)
    if path.stat().st_mode & 0o077:
        raise UserError(
            f"other users may read the private key {path}: chmod 600 it, and make new keys if somebody has read it"
        )
    try:
        from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 (an extra)
        from cryptography.hazmat.primitives.asymmetric import ed25519  # noqa: PLC0415
        from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415
    except ImportError as error:
        raise UserError(_INSTALL) from error
    try:
        key = load_pem_private_key(data, None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise UserError(f"{path} is not a private key: give a NAME.sign.key that `lavt keys` has made") from error
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise UserError(f"{path} is a key of another kind than Ed25519: give a NAME.sign.key that `lavt keys` has made")
    _check_expiry(data, path, now_wall_ns)
    return PrivateKey(key)


def load_public(path: Path, now_wall_ns: int | None = None) -> PublicKey:
    """Read an Ed25519 public key (PEM); raise `UserError` if it is invalid or has expired by `now_wall_ns`."""
    data = _read(path)
    try:
        from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 (an extra)
        from cryptography.hazmat.primitives.asymmetric import ed25519  # noqa: PLC0415
        from cryptography.hazmat.primitives.serialization import load_pem_public_key  # noqa: PLC0415
    except ImportError as error:
        raise UserError(_INSTALL) from error
    try:
        key = load_pem_public_key(data)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise UserError(f"{path} is not a public key: give a NAME.sign.pub that `lavt keys` has made") from error
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise UserError(f"{path} is a key of another kind than Ed25519: give a NAME.sign.pub that `lavt keys` has made")
    _check_expiry(data, path, now_wall_ns)
    return PublicKey(key)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"the key {path} cannot be read ({error.strerror}): make keys with `lavt keys DIR`") from error


class KeyAgreement:
    """One end of an X25519 key agreement (RFC 7748), used for one session."""

    def __init__(self) -> None:
        from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey  # noqa: PLC0415 (an extra)

        self._key = X25519PrivateKey.generate()
        self.public = self._key.public_key().public_bytes_raw()

    def derive_secret(self, other: bytes, context: bytes) -> bytes | None:
        """Return the 32 bytes shared with the owner of the public key `other`; None if `other` is not a valid key.

        Both ends must use the same `context`, the info of HKDF-SHA256 (RFC 5869).
        """
        from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey  # noqa: PLC0415 (an extra)
        from cryptography.hazmat.primitives.hashes import SHA256  # noqa: PLC0415
        from cryptography.hazmat.primitives.kdf.hkdf import HKDF  # noqa: PLC0415

        try:
            shared = self._key.exchange(X25519PublicKey.from_public_bytes(other))
        except ValueError:  # a wrong length, or a low-order point, with which every secret is the same
            return None
        return HKDF(SHA256(), SECRET_BYTES, None, context).derive(shared)


def encrypt(secret: bytes, plaintext: bytes, context: bytes) -> bytes:
    """Encrypt `plaintext` with AES-256-GCM; return a nonce of 12 bytes, the ciphertext and a tag of 16 bytes.

    `context` is authenticated, but not contained in the result.
    """
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM  # noqa: PLC0415 (an extra)

    nonce = secrets.token_bytes(NONCE_BYTES)
    return nonce + AESGCM(secret).encrypt(nonce, plaintext, context)


def decrypt(secret: bytes, data: bytes, context: bytes) -> bytes | None:
    """Decrypt the output of `encrypt`; return None if it is not authentic."""
    from cryptography.exceptions import InvalidTag  # noqa: PLC0415 (an extra)
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM  # noqa: PLC0415

    try:
        return AESGCM(secret).decrypt(data[:NONCE_BYTES], data[NONCE_BYTES:], context)
    except (InvalidTag, ValueError):
        return None
