from __future__ import annotations

import base64
from pathlib import Path

import pytest

from lavt.errors import UserError
from lavt.transport.signing import load_private, load_public

pytest.importorskip("cryptography", reason="an extra: pip install 'lavt[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

ED25519 = bytes.fromhex("06032b6570")
NOBODYS = bytes.fromhex("06032b6577")
"""An algorithm (object identifier 1.3.101.119) that no library knows."""


def test_a_key_of_an_unknown_algorithm_is_refused_in_a_sentence(tmp_path: Path) -> None:
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
