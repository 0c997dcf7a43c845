from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path

import pytest

from lavt.domain import NS_PER_S
from lavt.errors import UserError
from lavt.transport.security.keys import (
    NS_PER_DAY,
    KeyAgreement,
    decrypt,
    encrypt,
    key_expiry_ns,
    load_private,
    load_public,
)

pytest.importorskip("cryptography", reason="an extra: pip install -e '.[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from lavt.transport.security.certificates import new_signing_pair

NOW_NS = 1_795_520_000 * NS_PER_S
"""24 November 2026."""
ED25519 = bytes.fromhex("06032b6570")
UNKNOWN_ALGORITHM = bytes.fromhex("06032b6577")
"""Object identifier 1.3.101.119, which no library knows."""


def write_pair(directory: Path, key: Ed25519PrivateKey | X25519PrivateKey) -> tuple[Path, Path]:
    """Write a private key of mode 0600 and its public key; return their paths."""
    private, public = directory / "private", directory / "public"
    private.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    private.chmod(0o600)
    public.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    return private, public


def test_a_public_key_verifies_the_signatures_of_its_private_key(tmp_path: Path) -> None:
    """A signature has 64 bytes and is valid for the signed data only."""
    private, public = write_pair(tmp_path, Ed25519PrivateKey.generate())
    key = load_public(public)
    signature = load_private(private).sign(b"data")
    assert len(signature) == 64
    assert key.verify(signature, b"data")
    assert not key.verify(signature, b"other")
    assert not key.verify(bytes(64), b"data")
    assert not key.verify(b"", b"data")


def test_a_signing_key_expires(tmp_path: Path) -> None:
    """A pair expires after the given number of days; loading it without a time checks no expiry."""
    pair = new_signing_pair(NOW_NS, 30)
    for data, load in ((pair.private, load_private), (pair.public, load_public)):
        path = tmp_path / "key"
        path.write_bytes(data)
        path.chmod(0o600)
        assert key_expiry_ns(data, path) == NOW_NS + 30 * NS_PER_DAY
        load(path, NOW_NS + 30 * NS_PER_DAY - 1)
        load(path)
        with pytest.raises(UserError, match="expired on 2026-12-24"):
            load(path, NOW_NS + 30 * NS_PER_DAY)


def test_a_key_without_expiry_is_valid_at_any_time(tmp_path: Path) -> None:
    """A key without expiry, as other programs make it, is valid at any time."""
    private, public = write_pair(tmp_path, Ed25519PrivateKey.generate())
    load_private(private, 2**62)
    load_public(public, 2**62)
    assert key_expiry_ns(public.read_bytes(), public) is None


@pytest.mark.parametrize(
    "damage",
    [
        (b"key 1", b"key 2"),
        (b"expires ", b"expires"),
        (b"1798", b"x798"),
        (b"LAVT signing", b"LAVT  signing"),
        (b"LAVT", b"lavt"),
        (b"LAVT", b"#LAVT"),
        (b"(2026", b"(2036"),
        (b")\n", b")\nLAVT signing key 1, expires 4070908800 (2099-01-01)\n"),
    ],
)
def test_an_unreadable_expiry_is_rejected(tmp_path: Path, damage: tuple[bytes, bytes]) -> None:
    """A damaged expiry, one of another version or a second one does not make a key valid for longer or for ever."""
    assert damage[0] in new_signing_pair(NOW_NS, 30).public
    path = tmp_path / "key"
    path.write_bytes(new_signing_pair(NOW_NS, 30).public.replace(*damage, 1))
    with pytest.raises(UserError, match="expiry"):
        load_public(path, NOW_NS)


def test_an_expiry_behind_the_end_of_the_key_is_found(tmp_path: Path) -> None:
    """An expiry on the line that ends the key is not overlooked."""
    path = tmp_path / "key"
    expiry, _, key = new_signing_pair(NOW_NS, 30).public.partition(b"\n")
    assert key.startswith(b"-----BEGIN")
    path.write_bytes(key.rstrip() + b" " + expiry + b"\n")
    with pytest.raises(UserError):
        load_public(path, NOW_NS + 31 * 86_400 * NS_PER_S)


def test_without_a_time_the_text_outside_of_the_key_is_not_read(tmp_path: Path) -> None:
    """`lavt stop` needs no valid expiry: a comment in the file of a key must not prevent an emergency stop."""
    path = tmp_path / "key"
    path.write_bytes(b"a comment\n" + new_signing_pair(NOW_NS, 30).public)
    load_public(path)
    with pytest.raises(UserError, match="expiry"):
        load_public(path, NOW_NS)


def test_a_key_of_another_kind_is_rejected(tmp_path: Path) -> None:
    """A valid key that cannot sign, such as an X25519 key, is rejected, private or public."""
    private, public = write_pair(tmp_path, X25519PrivateKey.generate())
    for load, path in ((load_private, private), (load_public, public)):
        with pytest.raises(UserError, match="another kind"):
            load(path)


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o610, 0o604, 0o602, 0o601])
def test_a_private_key_with_permissions_for_others_is_rejected(tmp_path: Path, mode: int) -> None:
    """A private key is rejected if its group or other users have any permission on its file."""
    private, _ = write_pair(tmp_path, Ed25519PrivateKey.generate())
    private.chmod(mode)
    with pytest.raises(UserError, match="chmod 600"):
        load_private(private)


@pytest.mark.parametrize("load", [load_private, load_public])
def test_a_missing_or_malformed_key_file_is_rejected(tmp_path: Path, load: Callable[[Path], object]) -> None:
    """A key file that is missing or not a key raises a UserError that names `lavt keys`."""
    path = tmp_path / "key"
    with pytest.raises(UserError, match="lavt keys"):
        load(path)
    path.write_bytes(b"garbage")
    path.chmod(0o600)
    with pytest.raises(UserError, match="lavt keys"):
        load(path)


def test_two_ends_agree_on_a_secret() -> None:
    """Both ends derive the same 32 bytes; another context or peer gives another secret, and a bad key gives None."""
    one, other, third = KeyAgreement(), KeyAgreement(), KeyAgreement()
    secret = one.derive_secret(other.public, b"context")
    assert secret == other.derive_secret(one.public, b"context")
    assert secret is not None
    assert len(secret) == 32
    assert secret not in (one.derive_secret(other.public, b"else"), third.derive_secret(other.public, b"context"))
    assert one.derive_secret(bytes(31), b"context") is None
    assert one.derive_secret(bytes(32), b"context") is None


def test_encrypted_text_needs_its_secret_and_context() -> None:
    """Encryption adds a fresh nonce and a tag; another secret or context, or altered data, is rejected."""
    secret = bytes(range(32))
    data = encrypt(secret, b"text", b"context")
    assert len(data) == 12 + len(b"text") + 16
    assert encrypt(secret, b"text", b"context")[:12] != data[:12]
    assert decrypt(secret, data, b"context") == b"text"
    assert decrypt(bytes(32), data, b"context") is None
    assert decrypt(secret, data, b"else") is None
    assert decrypt(secret, data[:-1] + bytes([data[-1] ^ 1]), b"context") is None
    assert decrypt(secret, data[:5], b"context") is None


def test_a_key_of_an_unknown_algorithm_is_rejected(tmp_path: Path) -> None:
    """A PEM key of an unknown algorithm, private or public, raises a UserError that says so."""
    key = Ed25519PrivateKey.generate()
    private = key.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption())
    public = key.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    for kind, der, load in (("PRIVATE KEY", private, load_private), ("PUBLIC KEY", public, load_public)):
        text = base64.encodebytes(der.replace(ED25519, UNKNOWN_ALGORITHM)).decode()
        path = tmp_path / "key"
        path.write_text(f"-----BEGIN {kind}-----\n{text}-----END {kind}-----\n")
        path.chmod(0o600)
        with pytest.raises(UserError, match=f"is not a {kind.lower()}: give a NAME"):
            load(path)
