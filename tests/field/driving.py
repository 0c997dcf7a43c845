"""Run a control loop whose server and client are in different network namespaces, and cause outages in the loop."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tests.field.namespaces import INTERNET, VEHICLE, Direction, FieldNetworks

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.experiment.runs.processes import LAVT, Process, Processes
from lavt.recording.record import Record, read_record

SERVER = ("configs/server.yaml", "vehicle.route=straight", "vehicle.scenery=none", "vehicle.time_limit_s=3600")
CLIENT = ("configs/client.yaml", f"video.server={VEHICLE}", "controller.rearm=true")
CHANGES_OF_BOTH_SIDES = ("record.video=false",)
OBSERVER = Path(__file__).with_name("command_observer.py")
POLL_NS = 20 * NS_PER_MS
DRIVING_WITHIN_S = 90.0
"""In this time the sides find each other, and the client gets control, arms and speeds up; usual are 8 s."""


def wait_until(expectation: str, condition: Callable[[], bool], limit_s: float = DRIVING_WITHIN_S) -> None:
    clock = MachineClock()
    limit_ns = clock.now().mono_ns + round(limit_s * NS_PER_S)
    while not condition():
        assert clock.now().mono_ns < limit_ns, f"not within {limit_s:g} s: {expectation}"
        pause(POLL_NS)


def _udp_endpoint(host: str) -> str:
    return f"udp/{host}:7448?rel=1;mixed_rel=1"


def _embedded(file: str = "", **settings: Any) -> str:
    """Return the change of a side's config for an embedded router with a shipped file and changes of it."""
    router_file = f"zenoh-configs/{file}" if file else ""
    return "zenoh=" + json.dumps({"router_file": router_file, "router_settings": settings})


@dataclass(frozen=True)
class Links:
    """The changes of the configs of server and client; for separate routers and the rendezvous, also their configs."""

    server_changes: tuple[str, ...] = ()
    client_changes: tuple[str, ...] = ()
    vehicle_router: tuple[str, ...] = ()
    """Empty if the server contains its router, as by default. Otherwise the file, and changes of it."""
    operator_router: tuple[str, ...] = ()
    cloud_router: tuple[str, ...] = ()
    """Empty without a router in the cloud: the client's router then dials the vehicle's."""
    rendezvous: tuple[str, ...] = ()
    """Empty without a rendezvous: the client then reaches the vehicle directly."""


MIXED = Links()
"""The shipped configs: a reliable stream and best-effort datagrams over UDP, and a lease of 2 s."""
SEPARATE = Links(
    ("zenoh.router=tcp/127.0.0.1:7447",),
    ("zenoh.router=tcp/127.0.0.1:7457",),
    ("router-server.json5",),
    ("router-client.json5", f'connect.endpoints=["{_udp_endpoint(VEHICLE)}"]'),
)
"""The same with routers in processes of their own."""
LONG_LEASE = {"link": {"tx": {"lease": 10000}}}
TCP = Links(
    (_embedded(listen={"endpoints": ["tcp/127.0.0.1:7447", "tcp/0.0.0.0:7448"]}, transport=LONG_LEASE),),
    (_embedded(connect={"endpoints": [f"tcp/{VEHICLE}:7448"]}, transport=LONG_LEASE),),
)
"""Zenoh's defaults: TCP and a lease of 10 s. The kernel buffers messages during an outage and delivers them later."""
TO_CLOUD = {"endpoints": [_udp_endpoint(INTERNET)]}
CLOUD = Links(
    (_embedded("router-server-to-cloud.json5", connect=TO_CLOUD),),
    (_embedded("router-client.json5", connect=TO_CLOUD),),
    cloud_router=("router-server.json5", f'listen.endpoints=["{_udp_endpoint("0.0.0.0")}"]'),
)
"""The routers of vehicle and operator dial a router in the cloud."""


def signed(links: Links, keys: Path) -> Links:
    """Return links on which messages are signed and the video is encrypted with keys of `lavt keys`."""
    server = (
        f"security.key={keys}/vehicle-1.sign.key",
        f"security.operators={{operator-1: {keys}/operator-1.sign.pub}}",
    )
    client = (f"security.key={keys}/operator-1.sign.key", f"security.vehicle={keys}/vehicle-1.sign.pub")
    return replace(
        links, server_changes=(*links.server_changes, *server), client_changes=(*links.client_changes, *client)
    )


SIGNED_ONLY = Links(
    (_embedded("router-server.json5"),),
    (_embedded("router-client.json5", connect={"endpoints": [_udp_endpoint(VEHICLE)]}),),
)
"""Routers without certificates although the sides have keys."""


def through_rendezvous(keys: Path) -> Links:
    """Return links on which everything goes through the cloud, signed and encrypted with keys of `lavt keys`."""
    links = signed(CLOUD, keys)
    return replace(
        links,
        rendezvous=("rendezvous.yaml", f"bind={INTERNET}", f"vehicle_key={keys}/vehicle-1.sign.pub"),
        server_changes=(*links.server_changes, f"rendezvous.host={INTERNET}"),
        client_changes=(*links.client_changes, f"video.server={INTERNET}"),
    )


@dataclass(frozen=True)
class Outage:
    """An outage with its beginning and end; its effects are measured until the next outage begins."""

    name: str
    begin: Now
    end: Now


@dataclass
class Drive:
    """The processes of a control loop, which read the same clocks as the test, and the outages that the test caused."""

    networks: FieldNetworks
    processes: Processes
    work: Path
    links: Links = MIXED
    server_program: tuple[str, ...] = LAVT
    outages: list[Outage] = field(default_factory=list)
    running: dict[str, Process] = field(default_factory=dict)
    start_counts: dict[str, int] = field(default_factory=dict)
    clock: MachineClock = field(default_factory=MachineClock)

    def start(self) -> None:
        """Start all processes in order."""
        if self.links.cloud_router:
            self.start_process("cloud-router")
        if self.links.rendezvous:
            self.start_process("rendezvous")
        if self.links.vehicle_router:
            self.start_process("vehicle-router")
        self.start_process("server")
        self.start_process("observer")
        if self.links.operator_router:
            self.start_process("operator-router")
        self.start_process("client")

    def start_process(self, role: str) -> Process:
        """Start or restart the process with a role, and wait until it is ready."""
        self.start_counts[role] = self.start_counts.get(role, 0) + 1
        name = f"{role}-{self.start_counts[role]}"
        out = str(self.work / name)
        links = self.links
        server, client = (*SERVER, *links.server_changes), (*CLIENT, *links.client_changes)
        # For each role: the part of the network in which it runs, its arguments, and its program.
        starts: dict[str, tuple[str, list[str], tuple[str, ...]]] = {
            "vehicle-router": ("vehicle", _network_arguments("router", *links.vehicle_router), LAVT),
            "operator-router": ("operator", _network_arguments("router", *links.operator_router), LAVT),
            "cloud-router": ("internet", _network_arguments("router", *links.cloud_router), LAVT),
            "rendezvous": ("internet", _network_arguments("rendezvous", *links.rendezvous), LAVT),
            "server": (
                "vehicle",
                _side_arguments("server", server, out),
                self.server_program,
            ),
            "client": ("operator", _side_arguments("client", client, out), LAVT),
            "observer": ("vehicle", [out], (str(OBSERVER),)),
        }
        part, arguments, program = starts[role]
        process = self.networks.inside(part, lambda: self.processes.start(name, *arguments, program=program))
        process.wait_ready()
        self.running[role] = process
        return process

    def reach_speed(self, speed_mps: float) -> None:
        """Wait until the vehicle is driven, at this speed or more."""

        def is_reached() -> bool:
            status = self.running["server"].latest.get("status", {})
            phase = self.running["client"].latest.get("status", {}).get("phase")
            return (status.get("safety"), phase) == ("driving", "driving") and bool(status["speed_mps"] >= speed_mps)

        wait_until(f"the vehicle is driven at {speed_mps} m/s", is_reached)

    def wait_for_status(self) -> None:
        """Wait until the server has printed a status that is newer than this call."""
        server = self.running["server"]
        for _ in range(2):  # the first one may have been made before
            before = server.latest
            wait_until("the server prints a status", lambda before=before: server.latest is not before)  # type: ignore[misc]

    def block_network(self, name: str, directions: Sequence[Direction], duration_s: float) -> None:
        """Block the network in these directions for a while; `name` is the outage's name."""
        self.networks.block(directions)
        begin = self.clock.now()
        pause(round(duration_s * NS_PER_S))
        self.networks.unblock()
        self._note_outage(name, begin)

    def kill_and_restart(self, name: str, role: str, after_s: float) -> None:
        """Kill a process and restart it; the outage ends when the new process is ready."""
        begin = self.clock.now()
        self.running[role].popen.kill()
        pause(round(after_s * NS_PER_S))
        self.start_process(role)
        self._note_outage(name, begin)

    def freeze_process(self, name: str, role: str, duration_s: float) -> None:
        """Freeze a process with SIGSTOP for a while; `name` is the outage's name."""
        begin = self.clock.now()
        self.running[role].popen.send_signal(signal.SIGSTOP)
        pause(round(duration_s * NS_PER_S))
        self.running[role].popen.send_signal(signal.SIGCONT)
        self._note_outage(name, begin)

    def _note_outage(self, name: str, begin: Now) -> None:
        self.outages.append(Outage(name, begin, self.clock.now()))

    def records(self, side: str) -> list[Record]:
        """Read the records of all processes of a side."""
        return [
            read_record(self.work / f"{side}-{number}" / f"{side}.mcap")
            for number in range(1, self.start_counts[side] + 1)
        ]

    def observed_commands(self) -> list[dict[str, Any]]:
        """Return every command that the observer recorded."""
        lines = [json.loads(line) for line in (self.work / "observer-1").read_text().splitlines()]
        assert not any("invalid_message_bytes" in line for line in lines)
        return lines


@contextmanager
def running_loop(
    networks: FieldNetworks, work: Path, links: Links = MIXED, server_program: tuple[str, ...] = LAVT
) -> Iterator[Drive]:
    """Run a control loop in these networks."""
    with Processes(work) as processes:
        drive = Drive(networks, processes, work, links, server_program)
        drive.start()
        yield drive


def _network_arguments(command: str, *file_and_changes: str) -> list[str]:
    folder = {"router": "zenoh-configs", "rendezvous": "configs"}[command]
    return [command, *(f"{folder}/{file}" for file in file_and_changes[:1]), *_set_arguments(file_and_changes[1:])]


def _side_arguments(side: str, config_and_changes: tuple[str, ...], out: str) -> list[str]:
    config, *changes = config_and_changes
    return [side, config, *_set_arguments([*changes, *CHANGES_OF_BOTH_SIDES]), "--out", out]


def _set_arguments(changes: Sequence[str]) -> list[str]:
    return [part for change in changes for part in ("--set", change)]
