# ruff: noqa: D102 (test helpers with self-explanatory methods)

from __future__ import annotations

import json
import signal
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel
from tests.support.ports import free_port
from tests.support.stalls import LONG_STALL_MS, SharedResult, Stalls

from lavt.clock import MachineClock
from lavt.config import ZenohConfig
from lavt.domain import NS_PER_S
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.processes import Process, Processes
from lavt.experiment.runs.side_configs import client_config, server_config
from lavt.recording.record import Record, read_record

Wait = Callable[[str, Callable[[], bool], float], None]

START_LIMIT_S = 90.0
"""Processes start, routers find each other, a client gets control, arms and speeds up: 10 s on a quiet machine."""


def status(process: Process) -> dict[str, Any]:
    latest: dict[str, Any] = process.latest.get("status", {})
    return latest


def has_printed(process: Process, *words: str) -> bool:
    """Return whether a new message of a process contains all words."""
    lines = [process._first.get() for _ in range(process._first.qsize())]
    messages = [message for line in lines for message in (line or {}).get("said", [])]
    return any(all(word in message for word in words) for message in messages)


@dataclass
class Session:
    """A server and clients, with their reports, exit codes and times.

    The routers are separate. The processes start in the worst order: a client, the server, and only then the routers.
    """

    processes: Processes
    work: Path
    wait_until: Wait
    planned: PlannedRun
    observations: dict[str, Any] = field(default_factory=dict)
    """What a process reported at a moment, by the name of the moment."""
    at_ns: dict[str, int] = field(default_factory=dict)
    """The times of events of the session, by the event's name."""
    codes: dict[str, int | None] = field(default_factory=dict)
    clock: MachineClock = field(default_factory=MachineClock)

    def __post_init__(self) -> None:
        udp, tcp = socket.SOCK_DGRAM, socket.SOCK_STREAM
        self.server_endpoint, self.client_endpoint = (f"tcp/127.0.0.1:{free_port(tcp)}" for _ in range(2))
        self.link_of_routers = f"udp/127.0.0.1:{free_port(udp)}?rel=1;mixed_rel=1"
        self.probe_port = free_port(udp)

    def start_client(self, name: str, operator: str, *options: str) -> Process:
        run = self.planned.config
        config = client_config(
            run, run.seed, zenoh=ZenohConfig(router=self.client_endpoint), probe_port=self.probe_port
        )
        path = self.write(name, config.model_copy(update={"who": operator}))
        process = self.processes.start(name, "client", path, "--out", str(self.work / name), *options)
        process.wait_ready()
        return process

    def start_server(self) -> Process:
        config = server_config(self.planned.config, self.planned.seed, zenoh=ZenohConfig(router=self.server_endpoint))
        clock = config.clock.model_copy(update={"probe_port": self.probe_port})
        path = self.write("server", config.model_copy(update={"clock": clock}))
        process = self.processes.start("server", "server", path, "--out", str(self.work / "server"))
        process.wait_ready()
        return process

    def start_routers(self) -> None:
        link, local = [self.link_of_routers], [self.client_endpoint]
        self.start_router("server", listen=[self.server_endpoint, *link], connect=[])
        self.start_router("client", listen=local, connect=link)

    def start_router(self, side: str, **endpoints: list[str]) -> None:
        changes = [word for key, ends in endpoints.items() for word in ("--set", f"{key}.endpoints={json.dumps(ends)}")]
        file = f"zenoh-configs/router-{side}.json5"
        self.processes.start(f"{side}-router", "router", file, *changes).wait_ready()

    def write(self, name: str, config: BaseModel) -> str:
        path = self.work / f"{name}.yaml"
        path.write_text(yaml.safe_dump(config.model_dump(mode="json")))
        return str(path)

    def reach(self, server: Process, client: Process, speed_mps: float) -> None:
        def reached() -> bool:
            return status(client).get("phase") == "driving" and status(server).get("speed_mps", 0.0) >= speed_mps

        self.wait_until(f"{client.name} drives at {speed_mps} m/s", reached, START_LIMIT_S)

    def end(self, process: Process) -> None:
        self.at_ns[f"{process.name} interrupted"] = self.clock.now().mono_ns
        process.end()
        self.at_ns[f"{process.name} ended"] = self.clock.now().mono_ns
        self.codes[process.name] = process.popen.returncode
        self.observations[f"last of {process.name}"] = process.last_line()

    @cached_property
    def record(self) -> Record:
        """Return the record of the server, once it has ended."""
        return read_record(self.work / "server" / "server.mcap")


@pytest.fixture(scope="module")
def sessions(
    tmp_path_factory: pytest.TempPathFactory, wait_until: Wait, planned: Callable[..., PlannedRun], stalls: Stalls
) -> SharedResult[Session]:
    """Run a session in which control of the vehicle goes from one client to another."""
    clock = MachineClock()

    def run() -> Session:
        work = tmp_path_factory.mktemp("session")
        # A stall can stop the vehicle, and then no client drives on by itself: the session never reaches its end.
        excusing = stalls.excusing_failures(clock.now().mono_ns, stall_ms=LONG_STALL_MS)
        with excusing, Processes(work) as processes:
            session = Session(
                processes, work, wait_until, planned("vehicle.scenery=none", "controller.preset=designed")
            )
            session.at_ns["began"] = clock.now().mono_ns
            first = session.start_client("first", "operator-1")
            session.observations["first without a router"] = first.last_message()
            server = session.start_server()
            session.start_routers()
            session.reach(server, first, 2.0)

            waiting = session.start_client("waiting", "operator-2")
            wait_until("a rejection", lambda: "operator-1" in status(waiting).get("session", ""), START_LIMIT_S)
            session.observations["waiting"], session.observations["server while it waits"] = (
                status(waiting),
                status(server),
            )
            session.end(waiting)

            second = session.start_client("second", "operator-2", "--take-over")
            wait_until("a request at the client", lambda: has_printed(first, "operator-2", "SIGUSR2"), START_LIMIT_S)
            wait_until("a request", lambda: status(server).get("requested_by") == "operator-2", START_LIMIT_S)
            session.observations["requested"] = status(server)
            first.popen.send_signal(signal.SIGUSR2)
            session.reach(server, second, 1.0)
            session.observations["handed over"], session.observations["first after handover"] = (
                status(server),
                status(first),
            )

            session.end(second)
            wait_until("a release", lambda: status(server).get("active_operator") == "", START_LIMIT_S)
            session.end(server)
            session.end(first)
        return session

    return SharedResult(stalls, run)


@pytest.fixture
def session(sessions: SharedResult[Session]) -> Session:
    return sessions.get()


@pytest.fixture
def server(session: Session) -> Record:
    return session.record


def event_ns(record: Record, *words: str) -> int:
    """Return the time of the first event whose detail contains all words."""
    events = record.table("event")
    for at_ns, detail in zip(events.ints("mono_ns"), events.texts("detail"), strict=True):
        if all(word in detail for word in words):
            return int(at_ns)
    raise AssertionError(f"no event with {words}")


def test_a_client_started_before_its_router_and_server_drives(session: Session, server: Record) -> None:
    """A client that starts before the server and the routers reports that it waits, and drives later."""
    assert "no router answers" in session.observations["first without a router"]
    assert "waiting" in session.observations["first without a router"]
    assert event_ns(server, "arming -> driving")


def test_a_second_client_learns_who_has_control(session: Session, stalls: Stalls) -> None:
    """Without take-over a second client learns who has control, requests no handover, and ends with exit code 0."""
    assert session.observations["waiting"]["phase"] == "seeking"
    assert session.observations["waiting"]["active_operator"] == "operator-1"
    at_server = session.observations["server while it waits"]
    assert (at_server["active_operator"], at_server["requested_by"]) == ("operator-1", "")
    with stalls.excusing_failures(
        session.at_ns["began"], session.at_ns["waiting interrupted"], stall_ms=LONG_STALL_MS
    ):  # a stall can stop the vehicle
        assert at_server["safety"] == "driving"
    assert session.codes["waiting"] == 0


def test_the_active_operator_hands_over_on_request(session: Session, server: Record, stalls: Stalls) -> None:
    """After a request and SIGUSR2 the active operator releases the vehicle, which stops; then the requester drives."""
    requested = session.observations["requested"]
    assert (requested["active_operator"], requested["requested_by"]) == ("operator-1", "operator-2")
    assert session.observations["handed over"]["active_operator"] == "operator-2"
    first = session.observations["first after handover"]
    assert (first["phase"], first["session"]) == ("watching", "released")
    released_ns = event_ns(server, "release", "operator-1", "granted")
    with stalls.excusing_failures(session.at_ns["began"], released_ns, stall_ms=LONG_STALL_MS):  # it can stop before
        assert event_ns(server, "driving -> safe_stop") >= released_ns
    acquired_ns = event_ns(server, "acquire", "operator-2", "granted")
    assert acquired_ns >= released_ns
    with stalls.excusing_failures(released_ns, acquired_ns, stall_ms=LONG_STALL_MS):
        assert acquired_ns - released_ns < 2 * NS_PER_S


def test_ctrl_c_of_the_active_operator_releases_the_vehicle(session: Session, server: Record, stalls: Stalls) -> None:
    """Within a second after Ctrl-C the client releases the vehicle, reports the release and ends with exit code 0."""
    released_ns = event_ns(server, "release", "operator-2", "granted")
    interrupted_ns = session.at_ns["second interrupted"]
    assert interrupted_ns < released_ns
    with stalls.excusing_failures(interrupted_ns, released_ns, stall_ms=LONG_STALL_MS):
        assert released_ns - interrupted_ns < NS_PER_S
    assert "released" in session.observations["last of second"]["said"][-1]
    assert session.codes["second"] == 0


def test_a_server_ends_with_its_vehicle_stopped(session: Session, server: Record) -> None:
    """After Ctrl-C the server waits for standstill and ends with exit code 0 and a complete record."""
    assert "server ends" in session.observations["last of server"]["said"][-1]
    assert abs(server.table("truth").floats("speed_mps")[-1]) < 0.05
    assert session.codes["server"] == 0
    assert server.complete


def test_a_client_without_control_ends_soon(session: Session, stalls: Stalls) -> None:
    """Ctrl-C ends a client that has no control and whose server has ended within 3 s, with exit code 0."""
    assert session.codes["first"] == 0
    interrupted_ns, ended_ns = session.at_ns["first interrupted"], session.at_ns["first ended"]
    with stalls.excusing_failures(interrupted_ns, ended_ns, stall_ms=LONG_STALL_MS):
        assert ended_ns - interrupted_ns < 3 * NS_PER_S
