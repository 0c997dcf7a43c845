"""A drive with the secure configs, and an attacker at the operator's router that records, replays, alters and floods.

The permissions of the router's socket should prevent the attacker's session. The tests assume that these permissions
have failed, so that only the signatures protect the drive.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.field.secured_routers import BASE, QUIC, direct_handler, open_session

from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import Process, Processes
from lavt.recording.record import Record, read_record
from lavt.streams import stream
from lavt.transport.zenoh_link import CONTROL

PHASE_NS = 5 * NS_PER_S
FLOOD_PER_S = 10_000
START_LIMIT_S = 90.0
BURST = 50
"""Messages per call of `flood`."""
MAC_BYTES, SIGNATURE_BYTES = 16, 64
"""Sizes of the MAC and the signature at the end of a signed command, as in docs/wire.md."""


@dataclass
class AttackedDrive:
    """The records of a drive under one attack after the other."""

    phases: dict[str, tuple[int, int]]
    """Begin and end (ns) of each attack, and of the time without an attack, "quiet"."""
    sent_counts: dict[str, int]
    """Number of commands that each attack sent."""
    states_at_operator: list[bytes]
    server: Record
    client: Record
    last_status: dict[str, Any]


class Insider:
    """An attacker with a session at the operator's router."""

    def __init__(self, endpoint: str) -> None:
        self.session = open_session(endpoint)
        self.commands: list[bytes] = []
        self.states: list[bytes] = []
        self.queries: list[bytes] = []
        self.sent_counts: dict[str, int] = {}
        self._chance = stream(1, "insider")
        self.session.declare_subscriber(
            f"{BASE}/control", direct_handler(lambda sample: self.commands.append(bytes(sample.payload)))
        )
        self.session.declare_subscriber(
            f"{BASE}/state", direct_handler(lambda sample: self.states.append(bytes(sample.payload)))
        )
        self.session.declare_queryable(f"{BASE}/session", direct_handler(self._forge))
        self._control = self.session.declare_publisher(f"{BASE}/control", **{**CONTROL, "express": False})
        self._state = self.session.declare_publisher(f"{BASE}/state", **CONTROL)

    def _forge(self, query: Any) -> None:
        with query:
            self.queries.append(b"" if query.payload is None else query.payload.to_bytes())
            query.reply(f"{BASE}/session", self.queries[-1])

    def replay(self) -> None:
        """Replay the last 50 commands (of one second), the last 10 states, and the last 3 queries of the operator."""
        for data in self.commands[-50:]:
            self._put("replayed", data)
        for data in self.states[-10:]:
            self._state.put(data)
        for data in self.queries[-3:]:
            self.session.get(f"{BASE}/session", direct_handler(lambda _reply: None), payload=data, timeout=1.0)

    def alter(self) -> None:
        """Send the newest command and state with one bit flipped, and the command with a random signature."""
        for recorded, put in ((self.commands, self._control.put), (self.states, self._state.put)):
            data = bytearray(recorded[-1])
            data[int(self._chance.integers(len(data)))] ^= 1 << int(self._chance.integers(8))
            put(bytes(data))
        self._put("altered", self.commands[-1][:-SIGNATURE_BYTES] + self._chance.bytes(SIGNATURE_BYTES))

    def publish_to_wildcards(self) -> None:
        """Publish commands, states and random bytes to `**` and `lavt/**`."""
        for data in (self.commands[-1], self.states[-1], self._chance.bytes(200)):
            self.session.put("**", data)
            self.session.put("lavt/**", data)

    def flood(self) -> None:
        """Send a burst of copies of the newest command with a random MAC and signature."""
        authenticator_bytes = MAC_BYTES + SIGNATURE_BYTES
        body = self.commands[-1][:-authenticator_bytes]
        for _ in range(BURST):
            self._put("flood", body + self._chance.bytes(authenticator_bytes))

    def _put(self, name: str, data: bytes) -> None:
        self.sent_counts[name] = self.sent_counts.get(name, 0) + 1
        self._control.put(data)

    def close(self) -> None:
        """Close the session."""
        self.session.close()


def drive(work: Path, keys: Path) -> AttackedDrive:
    """Drive without an attack at first, then under one attack after the other."""
    clock = MachineClock()
    with Processes(work) as processes:
        insider, server, client = start_secure_loop(processes, work, keys)
        wait_until(clock, lambda: server.latest.get("status", {}).get("safety") == "driving", START_LIMIT_S)
        wait_until(clock, lambda: len(insider.commands) > 50 and len(insider.states) > 50, START_LIMIT_S)
        attacks: dict[str, tuple[Callable[[], None], int]] = {
            "quiet": (lambda: None, 20 * NS_PER_MS),
            "replayed": (insider.replay, 100 * NS_PER_MS),
            "altered": (insider.alter, 10 * NS_PER_MS),
            "wildcards": (insider.publish_to_wildcards, 20 * NS_PER_MS),
            "flood": (insider.flood, NS_PER_S * BURST // FLOOD_PER_S),
        }
        phases = {}
        for name, (attack, period_ns) in attacks.items():
            phases[name] = run_attack(clock, attack, period_ns)
            pause(NS_PER_S)
        status = server.latest["status"]
        insider.close()
        client.end()
        server.end()
        states_at_operator = [bytes(data) for data in insider.states]
    return AttackedDrive(
        phases,
        insider.sent_counts,
        states_at_operator,
        read_record(work / "server" / "server.mcap"),
        read_record(work / "client" / "client.mcap"),
        status,
    )


def run_attack(clock: MachineClock, attack: Callable[[], None], period_ns: int) -> tuple[int, int]:
    """Attack once per period for 5 s, and catch up after a stall of the machine; return when it began and ended."""
    began_ns = clock.now().mono_ns
    number = 0
    while (now_ns := clock.now().mono_ns) < began_ns + PHASE_NS:
        if now_ns < began_ns + number * period_ns:
            pause(began_ns + number * period_ns - now_ns)
        attack()
        number += 1
    return began_ns, clock.now().mono_ns


def start_secure_loop(processes: Processes, work: Path, keys: Path) -> tuple[Insider, Process, Process]:
    """Start `lavt server` and `lavt client` with the secure configs and embedded routers, and then the insider.

    The client's router listens at a socket, as if other programs needed it; there the insider gets in.
    """
    socket = f"unixsock-stream/{work}/operator.sock"
    listen = {"listen": {"endpoints": [QUIC]}, **tls_settings(keys, "vehicle-1", "listen")}
    server = processes.start(
        "server",
        "server",
        str(shipped("configs/server-secure.yaml")),
        "--out",
        str(work / "server"),
        *set_arguments(
            f"zenoh.router_settings={json.dumps(listen)}",
            f"security.key={keys}/vehicle-1.sign.key",
            f"security.operators={{operator-1: {keys}/operator-1.sign.pub}}",
            "video.bind=127.0.0.1",
            "video.port=0",
            "clock.probe_port=0",
            "clock.source=probe",
            "vehicle.scenery=none",
            "vehicle.route=a",
        ),
    )
    ready = server.wait_ready()["ready"]
    endpoints = {"listen": {"endpoints": [socket]}, "connect": {"endpoints": ready["locators"]}}
    dial = {**endpoints, **tls_settings(keys, "operator-1", "connect")}
    client = processes.start(
        "client",
        "client",
        str(shipped("configs/client-secure.yaml")),
        "--out",
        str(work / "client"),
        *set_arguments(
            f"zenoh.router_settings={json.dumps(dial)}",
            f"security.key={keys}/operator-1.sign.key",
            f"security.vehicle={keys}/vehicle-1.sign.pub",
            "video.server=127.0.0.1",
            f"video.port={ready['video_port']}",
            f"clock.probe_port={ready['probe_port']}",
            "clock.source=probe",
            "controller.rearm=true",
        ),
    )
    client.wait_ready()
    return Insider(socket), server, client


def tls_settings(keys: Path, name: str, action: str) -> dict[str, Any]:
    """Return the settings of an embedded router for the keys of `name`; `action` is "listen" or "connect"."""
    files = {"root_ca_certificate": "authority.pem", f"{action}_certificate": f"{name}.pem"}
    files[f"{action}_private_key"] = f"{name}.key"
    return {"transport": {"link": {"tls": {key: str(keys / file) for key, file in files.items()}}}}


def set_arguments(*changes: str) -> list[str]:
    """Return the command-line arguments for changes of a config."""
    return [word for change in changes for word in ("--set", change)]


def wait_until(clock: MachineClock, condition: Callable[[], bool], limit_s: float) -> None:
    """Wait until a condition is true."""
    limit_ns = clock.now().mono_ns + round(limit_s * NS_PER_S)
    while not condition():
        assert clock.now().mono_ns < limit_ns, f"the condition is not true within {limit_s:g} s"
        pause(50 * NS_PER_MS)
