"""Test what a user can name to reach a vehicle, and the sessions with which vehicles are searched."""

from __future__ import annotations

from pathlib import Path

import pytest

from lavt.assembly.addresses import parse_host
from lavt.assembly.zenoh import load_client_config, program_sessions, search_sessions, side_session
from lavt.config import ClientConfig
from lavt.config_file import shipped
from lavt.errors import UserError
from lavt.transport.zenoh_config import SessionSettings
from lavt.transport.zenoh_session import configured_endpoints


def dialled(session: SessionSettings) -> list[str]:
    """Return the endpoints that a session dials."""
    return configured_endpoints(session.path, "connect/endpoints", session.changes)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("vehicle", ("vehicle", None)),
        ("car_1.example-net.org", ("car_1.example-net.org", None)),
        ("192.0.2.7", ("192.0.2.7", None)),
        ("192.0.2.7:7449", ("192.0.2.7", 7449)),
        ("2001:db8::7", ("2001:db8::7", None)),
        ("[2001:db8::7]", ("2001:db8::7", None)),
        ("[2001:db8::7]:7449", ("2001:db8::7", 7449)),
    ],
)
def test_hosts(text: str, expected: tuple[str, int | None]) -> None:
    """A host is a name or an address, also of IPv6, with or without a port."""
    assert parse_host(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        *("", ":", ":7448", "host:", "host:0", "host:65536", "host:x", "host:７４４８", "a b", "a/b", "-host", "host-"),
        *(
            "tcp/192.0.2.7:7448",
            "[host]:7448",
            "[::1",
            "::1]",
            "[::1]7448",
            "fe80::1%eth0",
            "a\n",
            "a\x1b[2J",
            "a" * 300,
        ),
    ],
)
def test_no_hosts(text: str) -> None:
    """Everything else is rejected in one sentence of printable characters."""
    with pytest.raises(UserError, match="neither a config nor a host") as raised:
        parse_host(text)
    assert str(raised.value).isprintable()


def test_a_host_has_the_default_settings() -> None:
    """With a host alone, the client has the default settings, and dials the host; changes apply, too."""
    config = load_client_config("192.0.2.7", ["who=alice"])
    assert config == ClientConfig(who="alice", video=config.video)
    assert config.video.server == "192.0.2.7"
    assert dialled(side_session(config)) == ["udp/192.0.2.7:7448?mixed_rel=1;rel=1"]


@pytest.mark.parametrize("host", ["192.0.2.7", "[2001:db8::7]"])
def test_a_host_with_the_port_of_its_router(host: str) -> None:
    """A port in the argument is that of the vehicle's router."""
    config = load_client_config(f"{host}:7449", [])
    assert config.video.server == host.strip("[]")
    assert dialled(side_session(config)) == [f"udp/{host}:7449?mixed_rel=1;rel=1"]


def test_a_file_is_a_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An existing file is a config, whatever its name; a name of YAML is a config even if the file is missing."""
    monkeypatch.chdir(tmp_path)
    Path("localhost").write_text("who: bob")
    assert load_client_config("localhost", []).who == "bob"
    for name in ("missing.yaml", "missing.yml"):
        with pytest.raises(UserError, match="cannot be read"):
            load_client_config(name, [])
    Path("directory").mkdir()
    assert load_client_config("directory", []).video.server == "directory"


def test_the_search_asks_the_vehicles_router() -> None:
    """A search with a config asks the router that the client would dial; another router can be named instead."""
    config = load_client_config("192.0.2.7", [])
    (session,) = search_sessions(config)
    assert not session.is_router
    assert dialled(session) == dialled(program_sessions(config)[-1])
    (session,) = search_sessions(config, ["tcp/192.0.2.8:7447"])
    assert dialled(session) == ["tcp/192.0.2.8:7447"]


def test_the_search_without_a_config() -> None:
    """Without a config, a search asks the named router, or else those of a client and a server on this machine."""
    (session,) = search_sessions(None, ["tcp/192.0.2.8:7447"])
    assert dialled(session) == ["tcp/192.0.2.8:7447"]
    assert [dialled(session) for session in search_sessions(None)] == [["tcp/127.0.0.1:7457"], ["tcp/127.0.0.1:7447"]]


def test_the_search_with_keys_keeps_the_certificate(tmp_path: Path) -> None:
    """A search with keys uses the certificate of the config's router at every router."""
    config = load_client_config(str(shipped("configs/client-secure.yaml")), [])
    (session,) = search_sessions(config, ["quic/192.0.2.8:7448?mixed_rel=1"])
    assert session.path.name == "router-client-tls.json5"
    assert dialled(session) == ["quic/192.0.2.8:7448?mixed_rel=1"]
    assert list(tmp_path.iterdir()) == []
