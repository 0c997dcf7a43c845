# ruff: noqa: D102 (helpers of tests: short methods say themselves what they do)

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
from tests.support.stalls import LONG_STALL_MS, Shared, Stalls

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.processes import Process, Processes
from lavt.experiment.runs.real_run import start_client_router
from lavt.experiment.runs.side_configs import client_config, server_config
from lavt.recording.record import Record, read_record

Wait = Callable[[str, Callable[[], bool], float], None]

BEGINS_S = 90.0
"""Programs start, routers find each other, a client asks, arms and speeds up: about 10 s on a quiet machine."""
HELD = "held by operator-1, and the vehicle is not disarmed at standstill"
ASKS = "operator-2 requests control; SIGUSR2 hands the vehicle over"


def status(process: Process) -> dict[str, Any]:
    told: dict[str, Any] = process.latest.get("status", {})
    return told


def says(process: Process, text: str) -> bool:
    """Return whether one of the lines that were not looked at yet says it."""
    lines = [process._first.get() for _ in range(process._first.qsize())]
    return any(text in (line or {}).get("said", []) for line in lines)


@dataclass
class Session:
    """A server and clients, started in the worst order; `at_ns` has when what was done, on the clock of all."""

    processes: Processes
    work: Path
    wait_until: Wait
    planned: PlannedRun
    seen: dict[str, Any] = field(default_factory=dict)
    at_ns: dict[str, int] = field(default_factory=dict)
    codes: dict[str, int | None] = field(default_factory=dict)
    clock: MachineClock = field(default_factory=MachineClock)

    def __post_init__(self) -> None:
        udp, tcp = socket.SOCK_DGRAM, socket.SOCK_STREAM
        self.server_local, self.client_local = (f"tcp/127.0.0.1:{free_port(tcp)}" for _ in range(2))
        self.between = f"udp/127.0.0.1:{free_port(udp)}?rel=1;mixed_rel=1"
        self.probe_port = free_port(udp)

    def client(self, name: str, who: str, *options: str) -> Process:
        run = self.planned.config
        config = client_config(run, router=self.client_local, probe_port=self.probe_port)
        path = self.write(name, config.model_copy(update={"who": who}))
        process = self.processes.start(name, "client", path, "--out", str(self.work / name), *options)
        process.ready()
        return process

    def server(self) -> Process:
        config = server_config(self.planned.config, self.planned.seed, router=self.server_local)
        clock = config.clock.model_copy(update={"probe_port": self.probe_port})
        path = self.write("server", config.model_copy(update={"clock": clock}))
        process = self.processes.start("server", "server", path, "--out", str(self.work / "server"))
        process.ready()
        return process

    def routers(self) -> None:
        listen = f"listen.endpoints={json.dumps([self.server_local, self.between])}"
        self.processes.start("server-router", "router", "zenoh-configs/router-server.json5", "--set", listen).ready()
        start_client_router(self.processes, self.between, self.client_local)

    def write(self, name: str, config: BaseModel) -> str:
        path = self.work / f"{name}.yaml"
        path.write_text(yaml.safe_dump(config.model_dump(mode="json")))
        return str(path)

    def reach(self, server: Process, client: Process, speed_mps: float) -> None:
        def reached() -> bool:
            return status(client).get("phase") == "driving" and status(server).get("speed_mps", 0.0) >= speed_mps

        self.wait_until(f"{client.name} drives with {speed_mps} m/s", reached, BEGINS_S)

    def end(self, process: Process) -> None:
        self.at_ns[f"{process.name} told to end"] = self.clock.now().mono_ns
        process.end()
        self.at_ns[f"{process.name} ended"] = self.clock.now().mono_ns
        self.codes[process.name] = process.popen.returncode
        self.seen[f"last of {process.name}"] = process.last_line()

    @cached_property
    def record(self) -> Record:
        """Return what the server recorded, once it has ended."""
        return read_record(self.work / "server" / "server.mcap")


@pytest.fixture(scope="module")
def sessions(
    tmp_path_factory: pytest.TempPathFactory, wait_until: Wait, planned: Callable[..., PlannedRun], stalls: Stalls
) -> Shared[Session]:
    """One vehicle that goes from client to client."""

    def pass_on() -> Session:
        work = tmp_path_factory.mktemp("session")
        with Processes(work) as processes:
            drive = Session(processes, work, wait_until, planned("vehicle.scenery=none", "controller.preset=designed"))
            first = drive.client("first", "operator-1")
            drive.seen["first without a router"] = first.said()
            server = drive.server()
            drive.routers()
            drive.reach(server, first, 2.0)

            waiting = drive.client("waiting", "operator-2")
            wait_until("it is told", lambda: status(waiting).get("session") == HELD, BEGINS_S)
            drive.seen["waiting"], drive.seen["server while it waits"] = status(waiting), status(server)
            drive.end(waiting)

            second = drive.client("second", "operator-2", "--take-over")
            wait_until("the holder is told", lambda: says(first, ASKS), BEGINS_S)
            wait_until("the server tells it", lambda: status(server).get("requested_by") == "operator-2", BEGINS_S)
            drive.seen["requested"] = status(server)
            first.popen.send_signal(signal.SIGUSR2)
            drive.reach(server, second, 1.0)
            drive.seen["handed over"], drive.seen["first, then"] = status(server), status(first)

            drive.end(second)
            wait_until("nobody holds it", lambda: status(server).get("active_operator") == "", BEGINS_S)
            drive.end(server)
            drive.end(first)
        return drive

    return Shared(stalls, pass_on)


@pytest.fixture
def session(sessions: Shared[Session]) -> Session:
    return sessions.get()


@pytest.fixture
def server(session: Session) -> Record:
    return session.record


def event_ns(record: Record, detail: str) -> int:
    events = record.table("event")
    return next(
        int(at) for at, text in zip(events.ints("mono_ns"), events.texts("detail"), strict=True) if text == detail
    )


def test_a_client_started_before_its_router_and_its_server_gets_to_drive(session: Session, server: Record) -> None:
    """Client, server, routers: in this order the client says once what it waits for, and drives when all are there."""
    assert "no router answers" in session.seen["first without a router"]
    assert "waiting until one does" in session.seen["first without a router"]
    assert event_ns(server, "arming -> driving: armed by the client")


def test_a_second_client_is_told_who_holds_the_vehicle(session: Session) -> None:
    """Without take-over it waits, knows who holds the vehicle, asks nobody for it, and ends with 0."""
    assert session.seen["waiting"]["phase"] == "seeking"
    assert session.seen["waiting"]["active_operator"] == "operator-1"
    told = session.seen["server while it waits"]
    assert (told["safety"], told["active_operator"], told["requested_by"]) == ("driving", "operator-1", "")
    assert session.codes["waiting"] == 0


def test_the_active_operator_hands_over_to_who_asks(session: Session, server: Record, stalls: Stalls) -> None:
    """Asked and then told by SIGUSR2, the holder releases; the vehicle stops, and who asked arms and drives it."""
    assert (session.seen["requested"]["active_operator"], session.seen["requested"]["requested_by"]) == (
        "operator-1",
        "operator-2",
    )
    assert session.seen["handed over"]["active_operator"] == "operator-2"
    assert (session.seen["first, then"]["phase"], session.seen["first, then"]["session"]) == ("watching", "released")
    released_ns = event_ns(server, "release by operator-1 granted")
    assert event_ns(server, "driving -> safe_stop: the client released the vehicle") >= released_ns
    held_ns = event_ns(server, "hold by operator-2 granted")
    assert held_ns >= released_ns
    with stalls.judging(released_ns, held_ns, stall_ms=LONG_STALL_MS):
        assert held_ns - released_ns < 2 * NS_PER_S


def test_ctrl_c_of_the_active_operator_frees_the_vehicle(session: Session, server: Record, stalls: Stalls) -> None:
    """Within a second after Ctrl-C the vehicle is released and stopping; the client says so and has ended with 0."""
    released_ns = event_ns(server, "release by operator-2 granted")
    told_ns = session.at_ns["second told to end"]
    assert told_ns < released_ns
    with stalls.judging(told_ns, released_ns, stall_ms=LONG_STALL_MS):
        assert released_ns - told_ns < NS_PER_S
    assert session.seen["last of second"]["said"][-1] == "the client ends; the vehicle is released"
    assert session.codes["second"] == 0


def test_a_server_ends_with_its_vehicle_stopped(session: Session, server: Record) -> None:
    """After Ctrl-C the server waits for standstill, says so, and ends with 0 and a complete record."""
    assert session.seen["last of server"]["said"][-1] == "the vehicle is stationary; the server ends"
    assert abs(server.table("truth").floats("speed_mps")[-1]) < 0.05
    assert session.codes["server"] == 0
    assert server.complete


def test_a_client_whose_server_is_gone_ends_soon(session: Session, stalls: Stalls) -> None:
    """Ctrl-C ends a client that holds nothing, and whose server has ended, with 0 and without waiting for anybody."""
    assert session.codes["first"] == 0
    told_ns, ended_ns = session.at_ns["first told to end"], session.at_ns["first ended"]
    with stalls.judging(told_ns, ended_ns, stall_ms=LONG_STALL_MS):
        assert ended_ns - told_ns < 3 * NS_PER_S
