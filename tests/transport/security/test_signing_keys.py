from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path

import pytest

from lavt.errors import UserError
from lavt.transport.security.keys import KeyAgreement, decrypt, encrypt, load_private, load_public

pytest.importorskip("cryptography", reason="an extra: pip install 'lavt[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

ED25519 = bytes.fromhex("06032b6570")
NOBODYS = bytes.fromhex("06032b6577")
"""An algorithm (object identifier 1.3.101.119) that no library knows."""


def write_pair(directory: Path, key: Ed25519PrivateKey | X25519PrivateKey) -> tuple[Path, Path]:
    """Write a private key, which nobody else may read, and its public key; return their paths."""
    private, public = directory / "private", directory / "public"
    private.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    private.chmod(0o600)
    public.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    return private, public


def test_what_a_key_from_a_file_signs_its_public_key_verifies(tmp_path: Path) -> None:
    """A signature of 64 bytes is verified for the data that was signed and for no other data or signature."""
    private, public = write_pair(tmp_path, Ed25519PrivateKey.generate())
    key = load_public(public)
    signature = load_private(private).sign(b"data")
    assert len(signature) == 64
    assert key.verifies(signature, b"data")
    assert not key.verifies(signature, b"other")
    assert not key.verifies(bytes(64), b"data")
    assert not key.verifies(b"", b"data")


def test_a_key_of_another_kind_is_rejected(tmp_path: Path) -> None:
    """A key that is valid but cannot sign, such as one of X25519, is refused, private or public."""
    private, public = write_pair(tmp_path, X25519PrivateKey.generate())
    for load, path in ((load_private, private), (load_public, public)):
        with pytest.raises(UserError, match="another kind"):
            load(path)


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o610, 0o604, 0o602, 0o601])
def test_a_private_key_that_others_may_open_is_rejected(tmp_path: Path, mode: int) -> None:
    """A private key is refused when its group or anybody else has any permission on its file."""
    private, _ = write_pair(tmp_path, Ed25519PrivateKey.generate())
    private.chmod(mode)
    with pytest.raises(UserError, match="chmod 600"):
        load_private(private)


@pytest.mark.parametrize("load", [load_private, load_public])
def test_a_file_that_is_not_there_or_no_key_is_rejected(tmp_path: Path, load: Callable[[Path], object]) -> None:
    """A missing file, and a file of something else, are errors of the user."""
    path = tmp_path / "key"
    with pytest.raises(UserError, match="lavt keys"):
        load(path)
    path.write_bytes(b"garbage")
    path.chmod(0o600)
    with pytest.raises(UserError, match="lavt keys"):
        load(path)


def test_two_ends_agree_on_a_secret() -> None:
    """Both ends get the same 32 bytes; another context or another end gives others, and what is no key gives none."""
    one, other, third = KeyAgreement(), KeyAgreement(), KeyAgreement()
    secret = one.secret(other.public, b"context")
    assert secret == other.secret(one.public, b"context")
    assert secret is not None
    assert len(secret) == 32
    assert secret not in (one.secret(other.public, b"else"), third.secret(other.public, b"context"))
    assert one.secret(bytes(31), b"context") is None
    assert one.secret(bytes(32), b"context") is None


def test_encrypted_text_is_read_with_its_secret_and_context_only() -> None:
    """Encrypting adds a nonce of 12 bytes, new each time, and a tag of 16; altered or cut off it is not authentic."""
    secret = bytes(range(32))
    data = encrypt(secret, b"text", b"context")
    assert len(data) == 12 + len(b"text") + 16
    assert encrypt(secret, b"text", b"context")[:12] != data[:12]
    assert decrypt(secret, data, b"context") == b"text"
    assert decrypt(bytes(32), data, b"context") is None
    assert decrypt(secret, data, b"else") is None
    assert decrypt(secret, data[:-1] + bytes([data[-1] ^ 1]), b"context") is None
    assert decrypt(secret, data[:5], b"context") is None


def test_a_key_of_an_unknown_algorithm_is_rejected_in_a_sentence(tmp_path: Path) -> None:
    """A file that is PEM, but of an algorithm that nobody knows, is no key, private or public, and no traceback."""
    key = Ed25519PrivateKey.generate()
    private = key.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption())
    public = key.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    for kind, der, load in (("PRIVATE KEY", private, load_private), ("PUBLIC KEY", public, load_public)):
        text = base64.encodebytes(der.replace(ED25519, NOBODYS)).decode()
        path = tmp_path / "key"
        path.write_text(f"-----BEGIN {kind}-----\n{text}-----END {kind}-----\n")
        path.chmod(0o600)
        with pytest.raises(UserError, match=f"is not a {kind.lower()}: give a NAME"):
            load(path)
