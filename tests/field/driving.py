"""A loop whose ends are in networks of their own, driven and broken on purpose, and what its records say of it."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tests.field.namespaces import INTERNET, VEHICLE, Field, Way

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.experiment.runs.processes import LAVT, Process, Processes
from lavt.recording.record import Record, read_record

SERVER = ("configs/server.yaml", "vehicle.route=straight", "vehicle.scenery=none", "vehicle.time_limit_s=3600")
CLIENT = ("configs/client.yaml", f"video.server={VEHICLE}", "controller.rearm=true")
BOTH = ("record.video=false",)
OUTSIDE = Path(__file__).with_name("outside.py")
POLL_NS = 20 * NS_PER_MS
AGAIN_S = 90.0
"""Routers find each other, the client asks, arms and speeds up: about 8 s on a quiet machine."""


def wait_until(what: str, holds: Callable[[], bool], limit_s: float = AGAIN_S) -> None:
    clock = MachineClock()
    limit_ns = clock.now().mono_ns + round(limit_s * NS_PER_S)
    while not holds():
        assert clock.now().mono_ns < limit_ns, f"waited {limit_s:g} s in vain until {what}"
        pause(POLL_NS)


def _mixed(host: str) -> str:
    return f"udp/{host}:7448?rel=1;mixed_rel=1"


@dataclass(frozen=True)
class Links:
    """How the routers talk: the config of each, and what of it is changed."""

    vehicle: tuple[str, ...] = ("router-server.json5",)
    operator: tuple[str, ...] = ("router-client.json5", f'connect.endpoints=["{_mixed(VEHICLE)}"]')
    cloud: tuple[str, ...] = ()
    """Empty: there is no router in the cloud, and the operator's dials the vehicle's."""
    rendezvous: tuple[str, ...] = ()
    """Config and changes of what forwards video and probe in the cloud; empty: the client reaches the vehicle."""
    server: tuple[str, ...] = ()
    """Changes of the sides' configs."""
    client: tuple[str, ...] = ()


MIXED = Links()
"""As shipped: a reliable stream and best-effort datagrams over UDP, a lease of 2 s."""
TCP = Links(
    (
        "router-server.json5",
        'listen.endpoints=["tcp/127.0.0.1:7447", "tcp/0.0.0.0:7448"]',
        "transport.link.tx.lease=10000",
    ),
    ("router-client.json5", f'connect.endpoints=["tcp/{VEHICLE}:7448"]', "transport.link.tx.lease=10000"),
)
"""Zenoh's own: TCP and a lease of 10 s. The kernel keeps what is sent in an outage, and delivers it afterwards."""
CLOUD = Links(
    (
        "router-client.json5",
        'listen.endpoints=["tcp/127.0.0.1:7447"]',
        f'connect.endpoints=["{_mixed(INTERNET)}"]',
    ),
    ("router-client.json5", f'connect.endpoints=["{_mixed(INTERNET)}"]'),
    ("router-server.json5", f'listen.endpoints=["{_mixed("0.0.0.0")}"]'),
)
"""Both ends dial a router in the cloud."""


def through_rendezvous(keys: Path) -> Links:
    """Let both ends dial the cloud for everything: messages signed, video encrypted with what `lavt keys` has made."""
    return replace(
        CLOUD,
        rendezvous=("rendezvous.yaml", f"bind={INTERNET}", f"vehicle_key={keys}/vehicle-1.sign.pub"),
        server=(
            f"rendezvous.host={INTERNET}",
            f"security.key={keys}/vehicle-1.sign.key",
            f"security.operators={{operator-1: {keys}/operator-1.sign.pub}}",
        ),
        client=(
            f"video.server={INTERNET}",
            f"security.key={keys}/operator-1.sign.key",
            f"security.vehicle={keys}/vehicle-1.sign.pub",
        ),
    )


@dataclass(frozen=True)
class Outage:
    """What was broken when; its effects last until `over`, when the next begins."""

    name: str
    begin: Now
    end: Now


@dataclass
class Drive:
    """The processes of a loop, which are started again where one was killed; the test reads the clocks they read."""

    networks: Field
    processes: Processes
    work: Path
    links: Links = MIXED
    server_program: tuple[str, ...] = LAVT
    outages: list[Outage] = field(default_factory=list)
    running: dict[str, Process] = field(default_factory=dict)
    started: dict[str, int] = field(default_factory=dict)
    clock: MachineClock = field(default_factory=MachineClock)

    def start(self) -> None:
        """Start everything in order."""
        if self.links.cloud:
            self.start_again("cloud-router")
        if self.links.rendezvous:
            self.start_again("rendezvous")
        self.start_again("vehicle-router")
        self.start_again("outside")
        self.start_again("server")
        self.start_again("operator-router")
        self.start_again("client")

    def start_again(self, what: str) -> Process:
        """Start a part, for the first time or after its end, and wait until it is ready."""
        self.started[what] = self.started.get(what, 0) + 1
        name = f"{what}-{self.started[what]}"
        out = str(self.work / name)
        links = self.links
        table: dict[str, tuple[str, list[str], tuple[str, ...]]] = {
            "vehicle-router": ("vehicle", _carrier("router", *links.vehicle), LAVT),
            "operator-router": ("operator", _carrier("router", *links.operator), LAVT),
            "cloud-router": ("internet", _carrier("router", *links.cloud), LAVT),
            "rendezvous": ("internet", _carrier("rendezvous", *links.rendezvous), LAVT),
            "server": ("vehicle", _side("server", (*SERVER, *links.server), out), self.server_program),
            "client": ("operator", _side("client", (*CLIENT, *links.client), out), LAVT),
            "outside": ("vehicle", [out], (str(OUTSIDE),)),
        }
        part, arguments, program = table[what]
        process = self.networks.inside(part, lambda: self.processes.start(name, *arguments, program=program))
        process.ready()
        self.running[what] = process
        return process

    def reach(self, speed_mps: float) -> None:
        """Wait until the vehicle is driven, and this fast."""

        def reached() -> bool:
            told = self.running["server"].latest.get("status", {})
            phase = self.running["client"].latest.get("status", {}).get("phase")
            return (told.get("safety"), phase) == ("driving", "driving") and bool(told["speed_mps"] >= speed_mps)

        wait_until(f"the vehicle is driven with {speed_mps} m/s", reached)

    def cut(self, name: str, ways: Sequence[Way], duration_s: float) -> None:
        """Let the network carry nothing these ways for a while."""
        self.networks.block(ways)
        begin = self.clock.now()
        pause(round(duration_s * NS_PER_S))
        self.networks.unblock()
        self._over(name, begin)

    def kill_and_restart(self, name: str, what: str, after_s: float) -> None:
        """End a part with SIGKILL, and start it again; the outage ends when it is ready."""
        begin = self.clock.now()
        self.running[what].popen.kill()
        pause(round(after_s * NS_PER_S))
        self.start_again(what)
        self._over(name, begin)

    def freeze(self, name: str, what: str, duration_s: float) -> None:
        """Let a part stand still for a while."""
        begin = self.clock.now()
        self.running[what].popen.send_signal(signal.SIGSTOP)
        pause(round(duration_s * NS_PER_S))
        self.running[what].popen.send_signal(signal.SIGCONT)
        self._over(name, begin)

    def _over(self, name: str, begin: Now) -> None:
        self.outages.append(Outage(name, begin, self.clock.now()))

    def records(self, side: str) -> list[Record]:
        """Read what each process of a side has recorded."""
        return [
            read_record(self.work / f"{side}-{number}" / f"{side}.mcap") for number in range(1, self.started[side] + 1)
        ]

    def heard_outside(self) -> list[dict[str, Any]]:
        """Give every command that the process outside has heard."""
        lines = [json.loads(line) for line in (self.work / "outside-1").read_text().splitlines()]
        assert not any("unreadable" in line for line in lines)
        return lines


@contextmanager
def driven(
    networks: Field, work: Path, links: Links = MIXED, server_program: tuple[str, ...] = LAVT
) -> Iterator[Drive]:
    """Start a loop in these networks, and end it."""
    with Processes(work) as processes:
        drive = Drive(networks, processes, work, links, server_program)
        drive.start()
        yield drive


def _carrier(command: str, *file_and_changes: str) -> list[str]:
    folder = {"router": "zenoh-configs", "rendezvous": "configs"}[command]
    return [command, *(f"{folder}/{file}" for file in file_and_changes[:1]), *_sets(file_and_changes[1:])]


def _side(side: str, config_and_changes: tuple[str, ...], out: str) -> list[str]:
    config, *changes = config_and_changes
    return [side, config, *_sets([*changes, *BOTH]), "--out", out]


def _sets(changes: Sequence[str]) -> list[str]:
    return [part for change in changes for part in ("--set", change)]
