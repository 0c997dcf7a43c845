"""Test the list of vehicles that have answered, in particular with answers of strangers."""

from __future__ import annotations

import itertools
import json
import socket
from collections.abc import Iterator
from contextlib import closing
from typing import Any, NamedTuple

import msgpack
import pytest
import zenoh
from msgspec.structs import replace
from tests.support.clocks import ManualClock
from tests.support.ports import free_port

from lavt.assembly.zenoh import search_sessions
from lavt.clock import MachineClock
from lavt.config_file import shipped
from lavt.domain import NS_PER_S, VehicleInfo
from lavt.streams import stream
from lavt.transport import vehicle_search
from lavt.transport.messages import VERSION, encode
from lavt.transport.security.keys import SIGNATURE_BYTES
from lavt.transport.vehicle_search import (
    MAX_ANSWERS,
    MAX_LOCATORS,
    MAX_ROUTERS,
    MAX_VEHICLES,
    Answer,
    FoundVehicles,
    SearchSession,
    scout,
    usable_locators,
)

INFO = VehicleInfo("0.1.0", "driving", "armed by alice", "alice", 3.5, 2_000_000, 9)
ROUTER, OTHER_ROUTER = "udp/192.0.2.7:7448", "tcp/192.0.2.8:7448"
NONCE = bytes(16)


def answer(payload: bytes = encode(INFO), key: str = "lavt/vehicle-1/info", round_trip_ns: int = 1000) -> Answer:
    return Answer(key, payload, NONCE, round_trip_ns)


def found(*answers: Answer) -> FoundVehicles:
    """Return the vehicles found by these answers without keys."""
    vehicles = FoundVehicles({})
    for item in answers:
        vehicles.add(item, ROUTER)
    return vehicles


def test_a_vehicle_has_its_newest_information_and_all_round_trips() -> None:
    """Several answers of a vehicle are one entry with the newest information and each round trip."""
    newer = replace(INFO, safety="safe_stop")
    (vehicle,) = found(answer(), answer(encode(newer), round_trip_ns=3000)).vehicles()
    assert (vehicle.name, vehicle.router, vehicle.info) == ("vehicle-1", ROUTER, newer)
    assert vehicle.round_trips_ns == [1000, 3000]
    assert (vehicle.lavt_version, vehicle.message_version, vehicle.is_authentic) == ("0.1.0", VERSION, False)


def test_a_vehicle_behind_two_routers_is_one_entry() -> None:
    """A vehicle that answers over a second router keeps the first router, and the latency is that over the first."""
    vehicles = found(answer())
    vehicles.add(answer(round_trip_ns=9000), OTHER_ROUTER)
    (vehicle,) = vehicles.vehicles()
    assert (vehicle.router, vehicle.round_trips_ns) == (ROUTER, [1000])


def test_several_vehicles_behind_one_router() -> None:
    """Vehicles are listed by name, and two servers with the same name are two entries."""
    vehicles = found(
        answer(key="lavt/truck/info"), answer(key="lavt/car/info"), answer(encode(replace(INFO, instance=10)))
    )
    vehicles.add(answer(), ROUTER)
    assert [vehicle.name for vehicle in vehicles.vehicles()] == ["car", "truck", "vehicle-1", "vehicle-1"]


def test_a_vehicle_with_another_version_of_the_messages() -> None:
    """A vehicle whose messages have another version is listed with its versions, without its state."""
    payload = msgpack.packb([VERSION + 1, "9.0", {"anything": [1.5]}])
    for data in (payload, payload + bytes(SIGNATURE_BYTES)):
        (vehicle,) = found(answer(data)).vehicles()
        assert (vehicle.message_version, vehicle.lavt_version, vehicle.info) == (VERSION + 1, "9.0", None)


def test_a_signature_of_an_unknown_key_is_ignored() -> None:
    """A signed answer of a vehicle whose key is unknown is listed as not authentic."""
    (vehicle,) = found(answer(encode(INFO) + b"s" * SIGNATURE_BYTES)).vehicles()
    assert (vehicle.info, vehicle.is_authentic) == (INFO, False)


def test_a_known_key_verifies_the_answers_of_its_vehicle_only() -> None:
    """With the key of a vehicle, its answers must be signed for the query; those of others are not authentic."""

    def verify(vehicle: str, nonce: bytes, data: bytes) -> bytes | None:
        assert (vehicle, nonce) == ("vehicle-1", NONCE)
        return data[:-2] if data.endswith(b"ok") else None

    vehicles = FoundVehicles({"vehicle-1": verify})
    vehicles.add(answer(), ROUTER)
    assert vehicles.vehicles() == []
    assert vehicles.counts == {"answers_forged": 1}
    vehicles.add(answer(encode(INFO) + b"ok"), ROUTER)
    vehicles.add(answer(key="lavt/other/info"), ROUTER)
    assert {vehicle.name: vehicle.is_authentic for vehicle in vehicles.vehicles()} == {
        "vehicle-1": True,
        "other": False,
    }


@pytest.mark.parametrize(
    "key",
    [
        *("", "lavt//info", "lavt/*/info", "lavt/a/b/info", "lavt/car/info\n", "lavt/\x1b[2J/info", "lavt/car/state"),
        *("x/lavt/car/info", "lavt/-car/info", f"lavt/{'a' * 33}/info", "lavt/é/info", "lavt/car/infos"),
    ],
)
def test_an_answer_on_a_strange_key_is_counted(key: str) -> None:
    """An answer whose key does not contain a valid name of a vehicle is counted and not listed."""
    vehicles = found(answer(key=key))
    assert vehicles.vehicles() == []
    assert vehicles.counts == {"answers_unreadable": 1}


def test_strange_answers_are_counted() -> None:
    """Random bytes, empty, long, damaged and nested answers raise nothing, and are counted or are valid."""
    generator = stream(1, "strange answers")
    valid = encode(INFO)
    strange = [b"", b"\x91" * 1000, bytes(100_000), valid[:-1], valid + b"\0", msgpack.packb([VERSION, "0.1.0"])]
    strange += [generator.bytes(int(generator.integers(0, 300))) for _ in range(2000)]
    for _ in range(2000):
        damaged = bytearray(valid)
        damaged[int(generator.integers(len(valid)))] = int(generator.integers(256))
        strange.append(bytes(damaged))
    vehicles = found(*map(answer, strange))
    assert vehicles.counts["answers_unreadable"] > 2000
    assert len(vehicles.vehicles()) <= MAX_VEHICLES


def test_the_number_of_vehicles_is_limited() -> None:
    """A peer that answers for ever more vehicles fills the list up to its limit; further ones are counted."""
    vehicles = found(*(answer(key=f"lavt/car-{number}/info") for number in range(MAX_VEHICLES + 5)))
    assert len(vehicles.vehicles()) == MAX_VEHICLES
    assert vehicles.counts == {"answers_beyond_limit": 5}


@pytest.mark.parametrize(
    "locator",
    [
        "udp/192.0.2.7:7448?rel=1;mixed_rel=1",
        "quic/192.0.2.7:7448?mixed_rel=1",
        "tcp/192.0.2.7:7447",
        "tls/[2001:db8::7]:7448",
    ],
)
def test_usable_locators(locator: str) -> None:
    """A numeric address of another machine is dialled."""
    assert usable_locators([locator]) == [locator]


@pytest.mark.parametrize(
    "locator",
    [
        *("", "tcp/127.0.0.1:7447", "tcp/[::1]:7447", "udp/[fe80::1]:7448", "udp/0.0.0.0:7448", "udp/224.0.0.224:7446"),
        *("tcp/host.example:7447", "unixsock-stream//run/lavt/zenoh.sock", "tcp/999.0.2.7:7447", "tcp/192.0.2.7"),
        *("tcp/192.0.2.7:7447#iface=eth0", "tcp/192.0.2.7:7447\n", "tcp/192.0.2.7:7447?x=\x1b[2J", 5, None),
        *("tcp/192.0.2.7:0", "tcp/192.0.2.7:65536", "tcp/192.0.2.7:7447?so_sndbuf=1", "udp/192.0.2.7:7448?rel=7"),
        *("tcp/[::ffff:127.0.0.1]:7447", "tcp/[::ffff:169.254.169.254]:80", "tcp/[::127.0.0.1]:7447"),
        *("tcp/[64:ff9b::7f00:1]:7447", "tcp/0.1.2.3:7447", "tcp/255.255.255.255:7447", "tcp/240.0.0.1:7447"),
    ],
)
def test_locators_that_are_not_dialled(locator: object) -> None:
    """A name, a path, parameters of a socket, and an address on this machine or link are not dialled."""
    assert usable_locators([locator]) == []


def test_many_answers_are_reported() -> None:
    """If a query has as many answers as are read, there may have been more, and the vehicle's may be among them."""
    found = FoundVehicles({})
    found.add_all([answer()] * (MAX_ANSWERS - 1), ROUTER)
    assert not found.counts
    found.add_all([answer()] * MAX_ANSWERS, ROUTER)
    assert found.counts == {"answers_cut_off": 1}


def test_a_router_with_many_addresses() -> None:
    """Only the first addresses of a router are dialled."""
    locators = [f"tcp/192.0.2.{number}:7447" for number in range(1, 100)]
    assert usable_locators(locators) == locators[:MAX_LOCATORS]


class Hello(NamedTuple):
    """An answer to scouting."""

    zid: str
    locators: list[str]


class ManyHellos:
    """Stands for Zenoh's scouting: each of ever more routers answers twice."""

    def __init__(self) -> None:
        self.numbers = itertools.count()
        self.is_stopped = False

    def try_recv(self) -> Hello | None:
        """Return the next answer; every third time there is none."""
        number = next(self.numbers)
        if number % 3 == 2:
            return None
        router = number // 3
        return Hello(f"{router:x}", ["tcp/127.0.0.1:7447", f"udp/192.0.2.{router + 1}:7448"])

    def stop(self) -> None:
        """End scouting."""
        self.is_stopped = True


def test_scouting_returns_the_first_routers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scouting returns the usable addresses of the first routers, each once, and then stops."""
    hellos = ManyHellos()
    monkeypatch.setattr(zenoh, "scout", lambda *_, **__: hellos)
    monkeypatch.setattr(vehicle_search, "pause", lambda _: None)
    routers = scout(ManualClock(step_ns=1), 1.0)
    assert routers == [[f"udp/192.0.2.{number}:7448"] for number in range(1, MAX_ROUTERS + 1)]
    assert hellos.is_stopped


def test_scouting_ends_after_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scouting ends after its time if fewer routers answer."""
    hellos = ManyHellos()
    monkeypatch.setattr(zenoh, "scout", lambda *_, **__: hellos)
    monkeypatch.setattr(vehicle_search, "pause", lambda _: None)
    routers = scout(ManualClock(step_ns=NS_PER_S // 5), 1.0)
    assert 0 < len(routers) < 6
    assert hellos.is_stopped


@pytest.fixture(scope="module")
def search_session() -> Iterator[SearchSession]:
    """Yield a session with a router that answers each query with the number of answers that its nonce asks for."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    config = zenoh.Config.from_file(str(shipped("zenoh-configs/router-server.json5")))
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))

    def reply_often(query: Any) -> None:
        with query:
            for number in range(query.payload.to_bytes()[0]):
                query.reply("lavt/vehicle-1/info", bytes([number]))

    handler: Any = zenoh.handlers.Callback(reply_often, indirect=False)
    with zenoh.open(config) as router:
        router.declare_queryable("lavt/vehicle-1/info", handler)
        (settings,) = search_sessions(None, [endpoint])
        with closing(SearchSession(MachineClock(), settings)) as session:
            yield session


def test_every_answer_to_a_query_is_read(search_session: SearchSession) -> None:
    """Answers that arrive at once with the last one are read, too."""
    for count in (1, 2, MAX_ANSWERS):
        for _ in range(20):
            answers = search_session.query(bytes([count]), 30.0)
            assert [answer.payload[0] for answer in answers] == list(range(count))


def test_a_flood_of_answers_ends_the_query(search_session: SearchSession) -> None:
    """Only the first answers of a flood are read, and the next query has none of it."""
    answers = search_session.query(bytes([255]), 30.0)
    assert [answer.payload[0] for answer in answers] == list(range(MAX_ANSWERS))
    assert len(search_session.query(bytes([1]), 30.0)) == 1
