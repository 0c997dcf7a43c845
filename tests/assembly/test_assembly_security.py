"""The checks of a secure side's certificates before it opens its router."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lavt.assembly.side import open_client, open_server
from lavt.clock import MachineClock
from lavt.config import ClientConfig, ServerConfig
from lavt.config_file import build_config
from lavt.errors import UserError

certificates = pytest.importorskip("lavt.transport.security.certificates", exc_type=ImportError)


def write(file: Path, content: bytes) -> Path:
    file.write_bytes(content)
    file.chmod(0o600)
    return file


@pytest.mark.parametrize("side", ["server", "client"])
def test_a_side_with_an_expired_certificate_does_not_start(side: str, tmp_path: Path) -> None:
    """A server or client whose certificate has expired does not start, and names the file and the day."""
    clock = MachineClock()
    now_ns = clock.now().wall_ns
    begin_ns = now_ns - 10 * certificates.NS_PER_DAY
    authority = certificates.new_authority(begin_ns, 365)
    pair = certificates.new_certificate(authority, "one", "vehicle", server_hosts=(), now_wall_ns=begin_ns, days=9)
    signing = certificates.new_signing_pair(now_ns, 10)
    key, public = write(tmp_path / "one.sign.key", signing.private), write(tmp_path / "one.sign.pub", signing.public)
    kind = "listen" if side == "server" else "connect"
    tls = {
        "root_ca_certificate": str(write(tmp_path / "authority.pem", authority.public)),
        f"{kind}_certificate": str(write(tmp_path / "one.pem", pair.public)),
        f"{kind}_private_key": str(write(tmp_path / "one.key", pair.private)),
    }
    peers = {"operators": {"operator-1": str(public)}} if side == "server" else {"vehicle": str(public)}
    values = {
        "security": {"key": str(key), **peers},
        "zenoh": {"router_settings": {"transport": {"link": {"tls": tls}}}},
        "clock": {"source": "probe"},
    }
    text = f"{re.escape(str(tmp_path / 'one.pem'))} expired on "
    if side == "server":
        config = build_config(ServerConfig, values, [], "test")
        with pytest.raises(UserError, match=text), open_server(config, None, clock, print):
            pass
        return
    client_config = build_config(ClientConfig, values, [], "test")
    with pytest.raises(UserError, match=text), open_client(client_config, None, clock, print):
        pass
