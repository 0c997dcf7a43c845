from __future__ import annotations

import re
import shutil
import stat
import sys
from datetime import timedelta  # noqa: TID251 (no clock is read)
from pathlib import Path

import pytest
from tests.support.command_line import Run

pytest.importorskip("cryptography")

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from lavt.clock import calendar_time
from lavt.transport.security.keys import key_expiry_ns

ENDINGS = (".key", ".pem", ".sign.key", ".sign.pub")


@pytest.fixture
def run(run: Run) -> Run:
    """Return a function that runs `lavt keys`."""
    return lambda *arguments: run("keys", *arguments)


@pytest.fixture
def directory(run: Run) -> Path:
    """Return a directory with the keys of one name of each role."""
    names = [word for role in ("vehicle", "operator", "monitor", "cloud") for word in (f"--{role}", f"{role}-1")]
    code, _, err = run("keys", *names, "--host", "192.0.2.7", "--host", "car.example.org", "--days", "30")
    assert (code, err) == (0, "")
    return Path("keys")


def read_certificate(directory: Path, name: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((directory / f"{name}.pem").read_bytes())


def certified_hosts(directory: Path, name: str) -> set[str]:
    extension = read_certificate(directory, name).extensions.get_extension_for_class(x509.SubjectAlternativeName)
    return {str(host.value) for host in extension.value}


def certified_usages(directory: Path, name: str) -> set[x509.ObjectIdentifier]:
    return set(read_certificate(directory, name).extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)


def test_layout(directory: Path) -> None:
    """Each name has a certificate with its key and a signing pair, and only the owner can read private files."""
    names = [f"{role}-1" for role in ("vehicle", "operator", "monitor", "cloud")]
    expected = {name + ending for name in names for ending in ENDINGS} | {"authority.key", "authority.pem"}
    assert {path.name for path in directory.iterdir()} == expected
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in directory.glob("*.key")} == {0o600}


def test_certificates(directory: Path) -> None:
    """A certificate has the name and the key of its files and is signed by the authority."""
    authority = read_certificate(directory, "authority")
    for name in ("vehicle-1", "operator-1", "monitor-1", "cloud-1"):
        certificate = read_certificate(directory, name)
        certificate.verify_directly_issued_by(authority)
        (common_name,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        assert common_name.value == name
        key = serialization.load_pem_private_key((directory / f"{name}.key").read_bytes(), None)
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        assert key.curve.name == "secp256r1"
        assert key.public_key() == certificate.public_key()
        assert certificate.not_valid_after_utc == authority.not_valid_after_utc
        clock_skew_days = 1  # a certificate is valid from a day earlier
        assert (certificate.not_valid_after_utc - certificate.not_valid_before_utc).days == 30 + clock_skew_days


def test_server_certificates(directory: Path) -> None:
    """Vehicle and cloud may be TLS servers at the given hosts and the loopback; operator and monitor may not."""
    for name in ("vehicle-1", "cloud-1"):
        assert certified_hosts(directory, name) == {name, "127.0.0.1", "localhost", "192.0.2.7", "car.example.org"}
        assert certified_usages(directory, name) == {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH}
    for name in ("operator-1", "monitor-1"):
        assert certified_hosts(directory, name) == {name}
        assert certified_usages(directory, name) == {ExtendedKeyUsageOID.CLIENT_AUTH}


def test_signing_pairs(directory: Path) -> None:
    """The public signing key of a name verifies signatures of its private key, and no two names have the same pair."""
    public_keys = set()
    for name in ("vehicle-1", "operator-1"):
        key = serialization.load_pem_private_key((directory / f"{name}.sign.key").read_bytes(), None)
        public = serialization.load_pem_public_key((directory / f"{name}.sign.pub").read_bytes())
        assert isinstance(key, ed25519.Ed25519PrivateKey)
        assert isinstance(public, ed25519.Ed25519PublicKey)
        public.verify(key.sign(b"command"), b"command")
        public_keys.add(public.public_bytes_raw())
    assert len(public_keys) == 2


def test_instructions(run: Run) -> None:
    """The output has the expiry date and lists the files for each machine, without private keys of other machines."""
    code, out, _ = run("keys", "--vehicle", "car", "--operator", "ann", "--operator", "bob", "--cloud", "sky")
    assert code == 0
    lines = out.splitlines()
    assert re.search(r"\b2\d{3}\b", lines[0])
    assert "authority.key" in lines[0]
    copied = {
        name_line.split()[1].strip(","): set(files_line.split(": ")[1].split())
        for name_line, files_line in zip(lines[1:-1:2], lines[2:-1:2], strict=True)
    }
    own = {name: {"authority.pem", f"{name}.pem", f"{name}.key"} for name in ("car", "ann", "bob", "sky")}
    assert copied == {
        "car": own["car"] | {"car.sign.key", "ann.sign.pub", "bob.sign.pub"},
        "ann": own["ann"] | {"ann.sign.key", "car.sign.pub"},
        "bob": own["bob"] | {"bob.sign.key", "car.sign.pub"},
        "sky": own["sky"],
    }


def test_signing_keys_expire(run: Run, directory: Path) -> None:
    """Signing keys expire together with the certificate, and the output has the date."""
    code, out, _ = run("keys", "--operator", "ann", "--days", "30")
    assert code == 0
    for ending in (".sign.key", ".sign.pub"):
        path = directory / f"ann{ending}"
        expires_ns = key_expiry_ns(path.read_bytes(), path)
        assert expires_ns is not None
        assert abs(calendar_time(expires_ns) - read_certificate(directory, "ann").not_valid_after_utc) < timedelta(
            minutes=2
        )
        assert f"signing key until {calendar_time(expires_ns):%Y-%m-%d}" in out


def test_adding_names(run: Run, directory: Path) -> None:
    """A second run adds a name under the same authority, changes no other file, and lists all names."""
    before = {path: path.read_bytes() for path in directory.iterdir()}
    code, out, _ = run("keys", "--operator", "operator-2", "--days", "3000")
    assert code == 0
    assert "operator-1.sign.pub operator-2.sign.pub" in out
    new_certificate, authority = read_certificate(directory, "operator-2"), read_certificate(directory, "authority")
    new_certificate.verify_directly_issued_by(authority)
    assert new_certificate.not_valid_after_utc == authority.not_valid_after_utc
    assert {path: path.read_bytes() for path in before} == before
    assert len(list(directory.iterdir())) == len(before) + len(ENDINGS)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "no names"),
        (["--vehicle", "a/b"], "'a/b' is not a valid name"),
        (["--operator", "**"], r"'\*\*' is not a valid name"),
        (["--operator", "authority"], "'authority' is not a valid name"),
        (["--vehicle", "one", "--operator", "one"], "'one'.*twice"),
        (["--vehicle", "one", "--host", "192.0.2.7:7448"], "--host '192.0.2.7:7448'"),
        (["--vehicle", "one", "--host", "tcp/192.0.2.7"], "--host 'tcp/192.0.2.7'"),
        (["--vehicle", "one", "--host", "straße.example"], "--host 'straße.example'"),
        (["--operator", "one", "--host", "192.0.2.7"], "--vehicle or --cloud"),
        (["--vehicle", "one", "--days", "0"], "1 to 3650"),
        (["--vehicle", "one", "--days", "100000"], "1 to 3650"),
    ],
)
def test_bad_input(run: Run, arguments: list[str], sentence: str) -> None:
    """Invalid input is rejected in one sentence with exit code 2, and no file is created."""
    code, out, err = run("keys", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("lavt: ")
    assert not Path("keys").exists()
    assert re.search(sentence, err)


def test_nothing_is_overwritten(run: Run, directory: Path) -> None:
    """A name whose files exist is rejected, and the command creates no file."""
    before = {path: path.read_bytes() for path in directory.iterdir()}
    code, _, err = run("keys", "--operator", "operator-2", "--vehicle", "vehicle-1")
    assert code == 2
    assert "keys/vehicle-1.key" in err
    assert {path: path.read_bytes() for path in directory.iterdir()} == before


def test_damaged_authority(run: Run, directory: Path) -> None:
    """An authority whose key is missing or another's, or whose files are unreadable, is reported and signs nothing."""
    key = (directory / "authority.key").read_bytes()
    (directory / "authority.key").unlink()
    assert "keys/authority.key" in run("keys", "--operator", "two").rejection()
    shutil.copy(directory / "vehicle-1.key", directory / "authority.key")
    assert "certificate" in run("keys", "--operator", "two").rejection()
    (directory / "authority.key").write_bytes(b"nonsense")
    assert "PEM" in run("keys", "--operator", "two").rejection()
    (directory / "authority.key").write_bytes(key)
    (directory / "authority.pem").write_bytes(b"nonsense")
    assert "PEM" in run("keys", "--operator", "two").rejection()
    assert not list(directory.glob("two*"))


def test_directory_of_others(run: Run) -> None:
    """A directory that other users can read, or a file in its place, is rejected."""
    Path("open").mkdir(mode=0o755)
    Path("file").touch()
    assert "chmod 700 open" in run("open", "--vehicle", "one").rejection()
    assert "file" in run("file", "--vehicle", "one").rejection()


def test_without_the_library(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the library cryptography, the error names the package to install."""
    monkeypatch.delitem(sys.modules, "lavt.transport.security.certificates", raising=False)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    import lavt.transport.security

    monkeypatch.delattr(lavt.transport.security, "certificates", raising=False)
    assert "pip install -e '.[secure]'" in run("keys", "--vehicle", "one").rejection()
