"""Test which Zenoh sessions a side and other programs on its machine open."""

from __future__ import annotations

from typing import Any

import pytest

from lavt.assembly.zenoh import program_sessions, side_session
from lavt.config import ClientConfig, ServerConfig
from lavt.config_file import load_config, parse_config, shipped
from lavt.errors import UserError
from lavt.transport.zenoh_config import SessionSettings
from lavt.transport.zenoh_session import configured_endpoints

EMBEDDED = {"router": "embedded"}
CLIENT_KEYS = {"key": "operator-1.sign.key", "vehicle": "vehicle-1.sign.pub"}
SERVER_KEYS = {"key": "vehicle-1.sign.key", "operators": {"operator-1": "operator-1.sign.pub"}}


def server(zenoh: dict[str, Any], **sections: Any) -> ServerConfig:
    return parse_config(ServerConfig, {"zenoh": zenoh, **sections}, "server")


def client(zenoh: dict[str, Any], **sections: Any) -> ClientConfig:
    return parse_config(ClientConfig, {"zenoh": zenoh, "video": {"server": "192.0.2.7"}, **sections}, "client")


def endpoints(session: SessionSettings, key: str) -> list[str]:
    """Return the endpoints with which the session is opened."""
    return configured_endpoints(session.path, f"{key}/endpoints", session.changes)


def test_the_default_is_an_embedded_router() -> None:
    """Without a section `zenoh`, a server or client contains its router; a session file alone is rejected."""
    assert ServerConfig().zenoh.is_embedded
    assert ClientConfig().zenoh.is_embedded
    with pytest.raises(UserError, match=r"set zenoh\.router to the endpoint"):
        server({"session": "zenoh-configs/session-unix.json5"})


@pytest.mark.parametrize(("security", "protocol"), [({}, "udp"), (SERVER_KEYS, "quic")])
def test_a_servers_router_listens_as_its_file_says(security: dict[str, Any], protocol: str) -> None:
    """A server's embedded router has the unchanged shipped config, the encrypted one if the server has a key."""
    session = side_session(server(EMBEDDED, security=security))
    assert session.is_router
    assert session.path.name == ("router-server-tls.json5" if security else "router-server.json5")
    assert session.changes == {}
    assert [endpoint for endpoint in endpoints(session, "listen") if endpoint.startswith(f"{protocol}/0.0.0.0:7448")]


@pytest.mark.parametrize(
    ("security", "dialled", "local"),
    [
        ({}, "udp/192.0.2.7:7448?mixed_rel=1;rel=1", "tcp/127.0.0.1:7457"),
        (CLIENT_KEYS, "quic/192.0.2.7:7448?mixed_rel=1", "unixsock-stream//run/lavt/zenoh-client.sock"),
    ],
)
def test_a_clients_router_dials_the_vehicle(security: dict[str, Any], dialled: str, local: str) -> None:
    """A client's embedded router dials `video.server`, encrypted if the client has a key, and listens locally."""
    session = side_session(client(EMBEDDED, security=security))
    assert session.is_router
    assert session.path.name == ("router-client-tls.json5" if security else "router-client.json5")
    assert endpoints(session, "connect") == [dialled]
    assert endpoints(session, "listen") == [local]


def test_settings_replace_values_of_the_file() -> None:
    """`router_settings` replaces single values, also the endpoints that a client's router would choose itself."""
    settings = {"connect": {"endpoints": ["tcp/h:1"]}, "listen": {"endpoints": ["tcp/127.0.0.1:2"]}}
    session = side_session(client(EMBEDDED | {"router_settings": settings}))
    assert (endpoints(session, "connect"), endpoints(session, "listen")) == (["tcp/h:1"], ["tcp/127.0.0.1:2"])


def test_a_named_file_is_used_as_it_is() -> None:
    """A client's router with a file of its own dials the endpoints in this file."""
    session = side_session(client(EMBEDDED | {"router_file": "zenoh-configs/router-server-to-cloud.json5"}))
    assert session.path.resolve() == shipped("zenoh-configs/router-server-to-cloud.json5").resolve()
    assert endpoints(session, "connect") == ["udp/127.0.0.1:7448?mixed_rel=1;rel=1"]


def test_a_separate_router_is_reached_by_the_session_file() -> None:
    """Without an embedded router, a side and other programs have the same session, at the configured endpoint."""
    for config in (server({"router": "tcp/h:1"}), client({"router": "tcp/h:1"})):
        session = side_session(config)
        assert session == SessionSettings(session.path, {"connect/endpoints": ["tcp/h:1"]})
        assert program_sessions(config) == [session]
        assert session.path.name == "session.json5"
    unix = side_session(server({"router": "", "session": "zenoh-configs/session-unix.json5"}))
    assert endpoints(unix, "connect") == ["unixsock-stream//run/lavt/zenoh.sock"]


def test_a_program_on_the_clients_machine_has_two_ways_to_the_vehicle() -> None:
    """Another program connects to the client's router, or dials the vehicle itself, once and under an id of its own."""
    config = client(EMBEDDED | {"router_settings": {"id": "abc"}})
    by_client, direct = program_sessions(config)
    assert not by_client.is_router
    assert endpoints(by_client, "connect") == ["tcp/127.0.0.1:7457"]
    assert not direct.is_router
    assert direct.changes["mode"] == "client"
    assert direct.changes["id"] != "abc"
    assert endpoints(direct, "connect") == ["udp/192.0.2.7:7448?mixed_rel=1;rel=1"]
    assert endpoints(direct, "listen") == []


def test_a_program_dials_the_vehicle_if_the_clients_router_has_no_local_endpoint() -> None:
    """If the client's router listens nowhere, another program has only the way to the vehicle itself."""
    (session,) = program_sessions(client(EMBEDDED | {"router_settings": {"listen": {"endpoints": []}}}))
    assert endpoints(session, "connect") == ["udp/192.0.2.7:7448?mixed_rel=1;rel=1"]


@pytest.mark.parametrize(
    ("security", "local"), [({}, "tcp/127.0.0.1:7447"), (SERVER_KEYS, "unixsock-stream//run/lavt/zenoh.sock")]
)
def test_a_program_on_the_servers_machine_uses_the_servers_router(security: dict[str, Any], local: str) -> None:
    """Another program connects to the local endpoint of the server's embedded router."""
    (session,) = program_sessions(server(EMBEDDED, security=security))
    assert not session.is_router
    assert endpoints(session, "connect") == [local]


def test_a_servers_router_without_a_local_endpoint() -> None:
    """If the server's embedded router has no endpoint for local programs, the error says which key lacks one."""
    config = server(EMBEDDED | {"router_settings": {"listen": {"endpoints": ["udp/0.0.0.0:7448?rel=1;mixed_rel=1"]}}})
    with pytest.raises(UserError, match=r"listen\.endpoints"):
        program_sessions(config)


@pytest.mark.parametrize(
    ("zenoh", "key"),
    [
        (EMBEDDED | {"session": "zenoh-configs/session.json5"}, "zenoh.session"),
        ({"router": "tcp/h:1", "router_file": "router.json5"}, "zenoh.router_file"),
        ({"router": "", "router_settings": {"mode": "router"}}, "zenoh.router_settings"),
    ],
)
def test_keys_of_the_other_kind_of_router(zenoh: dict[str, Any], key: str) -> None:
    """A session file with an embedded router, or a router's config with a separate one, is rejected."""
    for parse in (server, client):
        with pytest.raises(UserError, match=key) as error:
            parse(zenoh)
        assert "\n" not in str(error.value)


def test_a_server_answers_scouting_only_if_its_config_says_so() -> None:
    """Multicast is off in every shipped router config; `zenoh.scouting` switches on the answers, and nothing else."""
    for path in shipped("zenoh-configs").glob("*.json5"):
        assert "multicast: { enabled: false }" in path.read_text(), path
    session = side_session(server({"scouting": True}))
    assert session.changes == {"scouting/multicast/enabled": True, "scouting/multicast/autoconnect": []}
    assert side_session(server({})).changes == {}
    with pytest.raises(UserError, match="for a server"):
        client({"scouting": True})


def test_the_plain_configs_are_the_defaults() -> None:
    """`lavt server` and `lavt client` without a config have the settings of the shipped plain configs."""
    assert load_config(ServerConfig, shipped("configs/server.yaml")) == ServerConfig()
    assert load_config(ClientConfig, shipped("configs/client.yaml")) == ClientConfig()
