"""A whole drive with the secure configs, and somebody at the operator's router who hears, repeats, alters and floods.

He has what the rights of the router's socket should keep from him: a session at the router of the operator. So all that
holds him back is what is signed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.field.secured import BASE, QUIC, dialled, direct, open_session, start_router, tls_changes

from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import Process, Processes
from lavt.recording.record import Record, read_record
from lavt.streams import stream
from lavt.transport.zenoh_link import CONTROL

PHASE_NS = 5 * NS_PER_S
FLOOD_PER_S = 10_000
LONGEST_S = 90.0
BURST = 50
SIGNATURE_BYTES = 64


@dataclass
class Drive:
    """What was recorded, and when which attack began and ended (monotonic clock of the machine)."""

    phases: dict[str, tuple[int, int]]
    sent: dict[str, int]
    shown: list[bytes]
    server: Record
    client: Record
    last_status: dict[str, Any]


class Insider:
    """Somebody with a session at the operator's router."""

    def __init__(self, endpoint: str) -> None:
        self.session = open_session(endpoint)
        self.commands: list[bytes] = []
        self.states: list[bytes] = []
        self.questions: list[bytes] = []
        self.sent: dict[str, int] = {}
        self._chance = stream(1, "insider")
        self.session.declare_subscriber(
            f"{BASE}/control", direct(lambda each: self.commands.append(bytes(each.payload)))
        )
        self.session.declare_subscriber(f"{BASE}/state", direct(lambda each: self.states.append(bytes(each.payload))))
        self.session.declare_queryable(f"{BASE}/session", direct(self._forge))
        self._control = self.session.declare_publisher(f"{BASE}/control", **{**CONTROL, "express": False})
        self._state = self.session.declare_publisher(f"{BASE}/state", **CONTROL)

    def _forge(self, query: Any) -> None:
        with query:
            self.questions.append(b"" if query.payload is None else query.payload.to_bytes())
            query.reply(f"{BASE}/session", self.questions[-1])

    def repeat(self) -> None:
        """Send what was heard once more: commands of the last second, and what the operator has asked."""
        for data in self.commands[-50:]:
            self._put("repeated", data)
        for data in self.states[-10:]:
            self._state.put(data)
        for data in self.questions[-3:]:
            self.session.get(f"{BASE}/session", direct(lambda _reply: None), payload=data, timeout=1.0)

    def alter(self) -> None:
        """Send newest command and state with one byte changed, and the command under a signature of random bytes."""
        for heard, put in ((self.commands, self._control.put), (self.states, self._state.put)):
            data = bytearray(heard[-1])
            data[int(self._chance.integers(len(data)))] ^= 1 << int(self._chance.integers(8))
            put(bytes(data))
        self._put("altered", self.commands[-1][:-SIGNATURE_BYTES] + self._chance.bytes(SIGNATURE_BYTES))

    def everywhere(self) -> None:
        """Publish to `**` what might be taken for anything."""
        for data in (self.commands[-1], self.states[-1], self._chance.bytes(200)):
            self.session.put("**", data)
            self.session.put("lavt/**", data)

    def flood(self) -> None:
        """Send a burst of what looks most like a true command: the newest, with random bytes for code and signature."""
        newest = self.commands[-1][:-80]
        for _ in range(BURST):
            self._put("flood", newest + self._chance.bytes(80))

    def _put(self, name: str, data: bytes) -> None:
        self.sent[name] = self.sent.get(name, 0) + 1
        self._control.put(data)

    def close(self) -> None:
        """Leave."""
        self.session.close()


def drive(work: Path, keys: Path) -> Drive:
    """Drive, quietly at first, then under one attack after the other."""
    clock = MachineClock()
    with Processes(work) as processes:
        insider, server, client = start_secure_loop(processes, work, keys)
        wait(clock, lambda: server.latest.get("status", {}).get("safety") == "driving", LONGEST_S)
        wait(clock, lambda: len(insider.commands) > 50 and len(insider.states) > 50, LONGEST_S)
        attacks: dict[str, tuple[Callable[[], None], int]] = {
            "quiet": (lambda: None, 20 * NS_PER_MS),
            "repeated": (insider.repeat, 100 * NS_PER_MS),
            "altered": (insider.alter, 10 * NS_PER_MS),
            "everywhere": (insider.everywhere, 20 * NS_PER_MS),
            "flood": (insider.flood, NS_PER_S * BURST // FLOOD_PER_S),
        }
        phases = {}
        for name, (attack, period_ns) in attacks.items():
            phases[name] = attacked(clock, attack, period_ns)
            pause(NS_PER_S)
        status = server.latest["status"]
        insider.close()
        client.end()
        server.end()
        shown = [bytes(data) for data in insider.states]
    return Drive(
        phases, insider.sent, shown, read_record(work / "server" / "server.mcap"),
        read_record(work / "client" / "client.mcap"), status,
    )  # fmt: skip


def attacked(clock: MachineClock, attack: Callable[[], None], period_ns: int) -> tuple[int, int]:
    """Attack once in every period, catching up after a pause of the machine."""
    began_ns = clock.now().mono_ns
    number = 0
    while (now_ns := clock.now().mono_ns) < began_ns + PHASE_NS:
        if now_ns < began_ns + number * period_ns:
            pause(began_ns + number * period_ns - now_ns)
        attack()
        number += 1
    return began_ns, clock.now().mono_ns


def start_secure_loop(processes: Processes, work: Path, keys: Path) -> tuple[Insider, Process, Process]:
    """Start both routers, `lavt server` and `lavt client` with the secure configs; the insider is there before."""
    sockets = {name: f"unixsock-stream/{work}/{name}.sock" for name in ("vehicle", "operator")}
    vehicle = start_router(
        processes, "vehicle", "router-server-tls.json5",
        f'listen.endpoints=["{sockets["vehicle"]}", "{QUIC}"]', *tls_changes(keys, "vehicle-1", "listen"),
    )  # fmt: skip
    start_router(
        processes, "operator", "router-client-tls.json5", f'listen.endpoints=["{sockets["operator"]}"]',
        f'connect.endpoints=["{dialled(vehicle)}"]', *tls_changes(keys, "operator-1", "connect"),
    ).ready()  # fmt: skip
    insider = Insider(sockets["operator"])
    server = processes.start(
        "server", "server", str(shipped("configs/server-secure.yaml")), "--out", str(work / "server"),
        *sets(
            f"zenoh.router={sockets['vehicle']}", f"security.key={keys}/vehicle-1.sign.key",
            f"security.operators={{operator-1: {keys}/operator-1.sign.pub}}", "video.bind=127.0.0.1", "video.port=0",
            "clock.probe_port=0", "clock.source=probe", "vehicle.scenery=none", "vehicle.route=a",
        ),
    )  # fmt: skip
    ports = server.ready()["ready"]
    client = processes.start(
        "client", "client", str(shipped("configs/client-secure.yaml")), "--out", str(work / "client"),
        *sets(
            f"zenoh.router={sockets['operator']}", f"security.key={keys}/operator-1.sign.key",
            f"security.vehicle={keys}/vehicle-1.sign.pub", "video.server=127.0.0.1",
            f"video.port={ports['video_port']}", f"clock.probe_port={ports['probe_port']}",
            "clock.source=probe", "controller.rearm=true",
        ),
    )  # fmt: skip
    client.ready()
    return insider, server, client


def sets(*changes: str) -> list[str]:
    """Give the arguments for changes of a config."""
    return [word for change in changes for word in ("--set", change)]


def wait(clock: MachineClock, holds: Callable[[], bool], limit_s: float) -> None:
    """Wait until something holds."""
    limit_ns = clock.now().mono_ns + round(limit_s * NS_PER_S)
    while not holds():
        assert clock.now().mono_ns < limit_ns, f"it did not hold within {limit_s:g} s"
        pause(50 * NS_PER_MS)
