"""`lavt vehicles`, and `lavt client` without an argument, with a real router and stand-ins for servers."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
import zenoh
from tests.support.command_line import Run
from tests.support.ports import free_port

from lavt.assembly.zenoh import search_sessions
from lavt.cli import vehicles
from lavt.cli.vehicles import printable, table_lines
from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, State, VehicleInfo
from lavt.node import Send
from lavt.transport import vehicle_search
from lavt.transport.messages import VERSION, encode
from lavt.transport.security.envelope import NullVehicleAuthenticator
from lavt.transport.security.gateway import INFO_NONCE_BYTES, ServerGateway
from lavt.transport.vehicle_search import FoundVehicle
from lavt.transport.zenoh_config import SessionSettings
from lavt.transport.zenoh_link import ZenohLink
from lavt.transport.zenoh_session import quiet_logs

ROUTER = shipped("zenoh-configs/router-server.json5")
ESCAPE = "\x1b[2J"


def open_vehicle(name: str, changes: dict[str, Any], *, is_router: bool) -> ZenohLink:
    """Return the link of a server that has sent a state."""
    path = ROUTER if is_router else shipped("zenoh-configs/session.json5")
    clock = MachineClock()
    settings = SessionSettings(path, changes, is_router=is_router)
    link = ZenohLink(clock, side="server", settings=settings, vehicle=name, who="server")
    gateway = ServerGateway(lambda *_: None, link.send, lambda: (0, -1), NullVehicleAuthenticator())
    link.start(gateway.receive)
    reason = f"stopped{ESCAPE}" if name == "car-2" else "stopped"
    gateway.send(
        Send(
            "state",
            encode(
                State(
                    sent_wall_ns=1,
                    state_mono_ns=clock.now().mono_ns,
                    speed_mps=0.5,
                    steering_rad=0.0,
                    gear="drive",
                    safety="safe_stop",
                    reason=reason,
                    applied_sequence=-1,
                    rejected="",
                    active_operator="alice" if name == "car-1" else "",
                    instance=7,
                )
            ),
        )
    )
    return link


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """Start a router with two vehicles behind it, and a peer that answers with garbage; yield its endpoint."""
    quiet_logs()
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with ExitStack() as stack:
        stack.enter_context(closing(open_vehicle("car-1", {"listen/endpoints": [endpoint]}, is_router=True)))
        stack.enter_context(closing(open_vehicle("car-2", {"connect/endpoints": [endpoint]}, is_router=False)))
        config = zenoh.Config.from_file(str(shipped("zenoh-configs/session.json5")))
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        stranger = stack.enter_context(zenoh.open(config))

        def answer(query: Any) -> None:
            with query:
                query.reply("lavt/stranger/info", ESCAPE.encode() * 100)

        handler: Any = zenoh.handlers.Callback(answer, indirect=False)
        stranger.declare_queryable("lavt/stranger/info", handler)
        wait_until_known(stranger, {"lavt/car-1/info", "lavt/car-2/info"})
        yield endpoint


def wait_until_known(session: Any, keys: set[str]) -> None:
    """Wait until the keys answer to a session, because a router learns of them one after the other."""
    for _ in range(600):
        replies = session.get("lavt/*/info", payload=bytes(INFO_NONCE_BYTES), timeout=1.0)
        if keys <= {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}:
            return
        pause(50 * NS_PER_MS)
    raise AssertionError(f"not all of {keys} have answered")


def test_the_table_of_vehicles(router: str, run: Run) -> None:
    """The table has each vehicle behind the router, and nothing of a peer that answers with garbage."""
    result = run("vehicles", "--router", router)
    header, *rows = (line.split("  ") for line in result.out.splitlines())
    assert result.code == 0
    assert "answers were ignored" in result.sentence()
    assert header[0] == "vehicle"
    assert [row[0] for row in rows] == ["car-1", "car-2"]
    assert ESCAPE not in result.out
    assert "alice" in result.out
    assert "nobody" in result.out
    assert result.out.count(router) == 2


def test_the_vehicles_as_json(router: str, run: Run) -> None:
    """The JSON has state, control, latency, age and versions of each vehicle, and the number of rejected answers."""
    result = run("vehicles", "--router", router, "--json")
    assert result.code == 0
    listed = json.loads(result.out)
    first, second = listed["vehicles"]
    assert (first["vehicle"], first["safety"], first["active_operator"]) == ("car-1", "safe_stop", "alice")
    assert (first["message_version"], first["is_compatible"], first["is_authentic"]) == (VERSION, True, False)
    assert first["round_trip_ms"] > 0
    assert first["state_age_ms"] > 0
    assert first["speed_mps"] == 0.5
    assert second["reason"] == f"stopped{ESCAPE}"
    assert ESCAPE not in result.out
    assert listed["rejected"]["answers_unreadable"] > 0


def test_a_router_that_does_not_answer(run: Run) -> None:
    """If the named router does not answer, the command says so in one sentence and ends with exit code 2."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    sentence = run("vehicles", "--router", endpoint).rejection()
    assert endpoint in sentence
    assert "`lavt server`" in sentence


@pytest.fixture
def nothing_local(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ARG001 (changes the directory first)
    """Let the search of this machine find nothing, whatever runs on it."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    settings = search_sessions(None, [endpoint])
    monkeypatch.setattr(vehicles, "search_sessions", lambda *_: settings)


@pytest.mark.parametrize("command", ["vehicles", "client"])
@pytest.mark.usefixtures("nothing_local")
def test_nothing_found(command: str, run: Run) -> None:
    """Without an answer, the command says in one sentence what to do, and ends with exit code 0."""
    result = run(command)
    assert (result.code, result.out) == (0, "")
    assert "no vehicle answers: start `lavt server`" in result.sentence()
    assert json.loads(run(command, "--json").out) == {"rejected": {}, "vehicles": []}


def test_a_client_without_an_argument_lists_the_vehicles(
    router: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`lavt client` alone lists the vehicles that answer on this machine, and says how to drive one."""
    settings = search_sessions(None, [router])
    monkeypatch.setattr(vehicles, "search_sessions", lambda *_: settings)
    result = run("client")
    assert result.code == 0
    assert "car-1" in result.out
    assert "`lavt client HOST`" in result.err


def test_scouting_asks_the_routers_that_it_finds(router: str, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """With --scout, the routers on the local network are asked; unusable and silent ones hide no others."""
    silent = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    monkeypatch.setattr(vehicles, "scout", lambda *_: [["tcp/192.0.2.1:0"], [silent], [router]])
    result = run("vehicles", "--scout", "--json")
    assert result.code == 0
    assert [vehicle["vehicle"] for vehicle in json.loads(result.out)["vehicles"]] == ["car-1", "car-2"]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["vehicles", "no host"], "neither a config nor a host"),
        (["vehicles", "missing.yaml"], "missing.yaml"),
        (["vehicles", "--set", "who=alice"], "name a host or a config"),
        (["vehicles", "--router", "foo/h:1"], "PROTOCOL/HOST:PORT"),
        (["client", "a/b"], "neither a config nor a host"),
        (["client", "host:70000"], "neither a config nor a host"),
        (["client", "2001:db8::7"], "IPv4"),
        (["client", "--take-over"], "name the vehicle's host"),
        (["client", "--out", "mine"], "name the vehicle's host"),
        (["client", "192.0.2.7", "--scout"], "--scout"),
        (["client", "192.0.2.7", "--set", "zenoh.scouting=true"], "for a server"),
        (["server", "--set", "zenoh={router: tcp/127.0.0.1:7447, scouting: true}"], "zenoh.scouting"),
        (["server", "--set", "vehicle.rute=a"], "vehicle.rute"),
    ],
)
def test_unusable_arguments(arguments: list[str], reason: str, run: Run) -> None:
    """An unusable host, router or option is rejected in one sentence with exit code 2."""
    result = run(*arguments)
    assert (result.code, result.out) == (2, "")
    assert reason in result.err.splitlines()[-1]


def test_two_servers_with_one_name(run: Run, router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """If two servers have the same name, both are listed, and a message says what to do."""
    instances = iter(range(100))
    parse = vehicle_search._parse

    def parse_as_another(payload: bytes) -> Any:
        versions, info = parse(payload)
        return versions, None if info is None else VehicleInfo(*[*vehicle_values(info)[:-1], next(instances) // 2 % 2])

    monkeypatch.setattr(vehicle_search, "_parse", parse_as_another)
    result = run("vehicles", "--router", router)
    assert result.code == 0
    assert "several servers have the name" in result.err


def vehicle_values(info: VehicleInfo) -> list[Any]:
    return [getattr(info, name) for name in info.__struct_fields__]


def test_the_table_has_no_control_characters() -> None:
    """A vehicle of another version is listed with its version, and control characters of strangers are replaced."""
    strange = f"2{ESCAPE}\n\r\u202e\x9b"
    vehicle = FoundVehicle("car", "tcp/192.0.2.7:7447", 9, strange, None, False, [2 * NS_PER_MS])
    header, row = table_lines([vehicle])
    assert header.isprintable()
    assert row.isprintable()
    assert f"2?[2J???? (messages 9, here {VERSION}" in row
    assert "2.0 ms" in row
    assert printable(strange) == "2?[2J????"
    assert table_lines([]) == []


def test_a_server_without_a_config_says_how_to_drive_it(run: Run) -> None:
    """`lavt server` alone says in one sentence that it is the simulator and how to drive it, before it starts."""
    changes = ("zenoh={router_settings: {connect: {endpoints: [foo/h:1]}}}", "video.port=0", "clock.probe_port=0")
    result = run("server", *(word for change in changes for word in ("--set", change)))
    first, last = result.err.splitlines()
    assert first.startswith("lavt: default settings, vehicle: simulator; ")
    assert "`lavt client HOST`" in first
    assert (result.code, result.out) == (2, "")
    assert "foo/h:1" in last
