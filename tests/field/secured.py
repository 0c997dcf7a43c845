"""Routers as shipped for two machines, encrypted, on the loopback; who may use them, and who tries to.

Bare Zenoh sessions stand in for the vehicle and the operator, and attack: they are held back by nothing of LAVT's.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import Process, Processes
from lavt.transport.zenoh_link import CONTROL, STATE

BASE = "lavt/vehicle-1"
QUIC = "quic/127.0.0.1:0?mixed_rel=1"
ROUND_NS = 20 * NS_PER_MS
ROUNDS = 25
"""The operator's so many commands, states and answers come while somebody attacks: nothing less was given time."""
LIMIT_S = 15.0
LONG = 5000


def make_keys(directory: Path, *arguments: str) -> None:
    """Run `lavt keys`."""
    subprocess.run([sys.executable, "-m", "lavt", "keys", str(directory), *arguments], check=True, capture_output=True)


def tls_changes(keys: Path, name: str, way: str) -> tuple[str, ...]:
    """Say where the keys of a router are that listens or connects (`way`)."""
    base = "transport.link.tls"
    return (
        f"{base}.root_ca_certificate={keys}/authority.pem",
        f"{base}.{way}_certificate={keys}/{name}.pem",
        f"{base}.{way}_private_key={keys}/{name}.key",
    )


def start_router(processes: Processes, name: str, file: str, *changes: str) -> Process:
    """Start `lavt router` with a shipped config and `--set` for each change."""
    sets = [word for change in changes for word in ("--set", change)]
    return processes.start(name, "router", str(shipped(f"zenoh-configs/{file}")), *sets)


def dialled(router: Process) -> str:
    """Where other routers dial this one, as an endpoint."""
    return str(next(each for each in router.ready()["locators"] if each.startswith("quic/")))


def port(endpoint: str) -> int:
    """UDP port of such an endpoint."""
    return int(endpoint.partition("?")[0].rpartition(":")[2])


def open_session(endpoint: str, mode: str = "client", *, authority: Path | None = None, own: Path | None = None) -> Any:
    """Open a session at `endpoint` as a client, or beside it as a router, with or without a certificate of its own.

    `authority` is the certificate it trusts; `own` is that of the session, its key beside it.
    """
    tls: dict[str, Any] = {"enable_mtls": own is not None}
    if authority is not None:
        tls["root_ca_certificate"] = str(authority)
    if own is not None:
        tls |= {"connect_certificate": str(own), "connect_private_key": str(own.with_suffix(".key"))}
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "connect": {"endpoints": [endpoint], "timeout_ms": 0, "exit_on_failure": mode == "client"},
        "listen": {"endpoints": [] if mode == "client" else ["tcp/127.0.0.1:0"]},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tls": tls,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def direct(hear: Callable[[Any], None]) -> Any:
    """Make a handler that hears on Zenoh's own thread."""
    return zenoh.handlers.Callback(hear, indirect=False)


class Vehicle:
    """Stands in for `lavt server`: hears commands, answers questions, tells a state."""

    def __init__(self, endpoint: str) -> None:
        self.commands: list[bytes] = []
        self.deleted = 0
        self.requested: list[bytes] = []
        self.session = open_session(endpoint)
        self._state = self.session.declare_publisher(f"{BASE}/state", **STATE)
        self.session.declare_subscriber(f"{BASE}/control", direct(self._hear))
        for key in (f"{BASE}/session", f"{BASE}/netem"):
            self.session.declare_queryable(key, direct(self._answer))
        self._alive = self.session.liveliness().declare_token(f"{BASE}/alive/server-1")

    def tell(self) -> None:
        """Tell a state."""
        self._state.put(b"state")

    def _hear(self, sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self.deleted += 1
        self.commands.append(sample.payload.to_bytes())

    def _answer(self, query: Any) -> None:
        with query:
            self.requested.append(b"" if query.payload is None else query.payload.to_bytes())
            for key in (f"{BASE}/session", f"{BASE}/netem"):
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, b"answer of " + key.rpartition("/")[2].encode())


class Client:
    """Stands in for `lavt client`: sends commands that bear a name, hears the state, asks."""

    def __init__(self, session: Any, name: bytes) -> None:
        self.session = session
        self.name = name
        self.heard: dict[str, list[bytes]] = {}
        self.answers: list[bytes] = []
        self._own_id = str(session.info.zid())
        self._control = session.declare_publisher(f"{BASE}/control", **CONTROL)
        self.listen(f"{BASE}/state")

    def listen(self, key: str) -> None:
        """Hear what comes on a key, kept under it."""
        kept = self.heard.setdefault(key, [])
        self.session.declare_subscriber(key, direct(lambda sample: kept.append(sample.payload.to_bytes())))

    def command(self) -> None:
        """Send a command."""
        self._control.put(self.name)

    def ask(self, key: str) -> None:
        """Ask a question; what comes back is kept."""
        self.session.get(key, direct(self._answered), payload=self.name, timeout=1.0)

    def _answered(self, reply: Any) -> None:
        if reply.ok is not None and self._own_id not in str(reply.ok.key_expr):  # a session tells itself of itself
            self.answers.append(reply.ok.payload.to_bytes())


@dataclass
class Site:
    """A vehicle and its operator at routers of their own, which found each other."""

    keys: Path
    endpoint: str
    """Where the router is dialled that everybody from outside dials: the vehicle's or a cloud's."""
    operator_socket: Path
    vehicle: Vehicle
    operator: Client
    processes: Processes
    clock: MachineClock = field(default_factory=MachineClock)

    def intruder(self, name: str, mode: str) -> Intruder:
        """Dial with the certificate of `name`, of this site's authority."""
        own = self.keys / f"{name}.pem"
        return Intruder(open_session(self.endpoint, mode, authority=self.keys / "authority.pem", own=own))

    def drive(self, beside: Callable[[], None] = lambda: None) -> None:
        """Have `ROUNDS` commands, states and answers of both questions come through, and do something in each round."""
        commands, states, answers = (len(each) for each in self._came())
        limit_ns = self._limit_ns()
        while True:
            self._round(beside)
            now_commands, now_states, now_answers = (len(each) for each in self._came())
            came = min(now_commands - commands, now_states - states, (now_answers - answers) // 2)
            if came >= ROUNDS:
                return
            assert self.clock.now().mono_ns < limit_ns, f"only {came} rounds came through in {LIMIT_S:g} s"

    def attack(self, intruder: Intruder, aims: set[str]) -> set[str]:
        """Have `intruder` try all it can in each round until it has achieved `aims`, or time is up; say what it has."""
        limit_ns = self._limit_ns()
        while True:
            self._round(intruder.attempt)
            achieved = intruder.achieved(self)
            if achieved >= aims or self.clock.now().mono_ns >= limit_ns:
                return achieved

    def _limit_ns(self) -> int:
        return self.clock.now().mono_ns + round(LIMIT_S * NS_PER_S)

    def _round(self, beside: Callable[[], None]) -> None:
        beside()
        self.operator.command()
        self.vehicle.tell()
        for question in ("session", "netem"):
            self.operator.ask(f"{BASE}/{question}")
        pause(ROUND_NS)

    def _came(self) -> tuple[list[bytes], list[bytes], list[bytes]]:
        return (
            [each for each in self.vehicle.commands if each == self.operator.name],
            [each for each in self.operator.heard[f"{BASE}/state"] if each == b"state"],
            [each for each in self.operator.answers if each.startswith(b"answer of ")],
        )


class Intruder(Client):
    """Somebody with a session who tries all there is: `attempt` in each round, `achieved` in the end."""

    def __init__(self, session: Any) -> None:
        super().__init__(session, b"intruder")
        for key in ("**", "lavt/**", "lavt/*/*", f"{BASE}/control"):
            self.listen(key)
        self.alive: list[str] = []
        session.liveliness().declare_subscriber(
            f"{BASE}/alive/*", direct(lambda sample: self.alive.append(str(sample.key_expr))), history=True
        )
        for key in (f"{BASE}/session", f"{BASE}/netem", "lavt/**"):
            session.declare_queryable(key, direct(self._forge), complete=True)

    def attempt(self) -> None:
        """Send everything once."""
        self.command()
        for key in ("**", "lavt/**", "lavt/*/control", f"{BASE}/*"):
            self.session.put(key, b"wildcard")
        self.session.delete(f"{BASE}/control")
        self.session.put(f"{BASE}/control", b"long" * (LONG // 4))
        self.session.put(f"{BASE}/state", b"forged")
        for key in (f"{BASE}/session", f"{BASE}/netem", "lavt/**", "@/**"):
            self.ask(key)

    def achieved(self, site: Site) -> set[str]:
        """Say what had an effect on vehicle or operator, and what was learned."""
        seen = [each for key, heard in self.heard.items() for each in heard if key != f"{BASE}/state"]
        answers = set(self.answers) - {b"forged"}
        effects = {
            "commands": b"intruder" in site.vehicle.commands,
            "wildcard commands": b"wildcard" in site.vehicle.commands,
            "deletes": site.vehicle.deleted > 0,
            "long commands": any(len(each) >= LONG for each in site.vehicle.commands),
            "questions": b"intruder" in site.vehicle.requested,
            "session": b"answer of session" in answers,
            "netem": b"answer of netem" in answers,
            "the routers' own state": bool(answers - {b"answer of session", b"answer of netem"}),
            "forged state": any(each != b"state" for each in site.operator.heard[f"{BASE}/state"]),
            "forged answers": b"forged" in site.operator.answers,
            "state": b"state" in self.heard[f"{BASE}/state"],
            "others' commands": site.operator.name in seen,
            "alive": f"{BASE}/alive/server-1" in self.alive,
        }
        return {effect for effect, came in effects.items() if came}

    def close(self) -> None:
        """Leave."""
        self.session.close()

    @staticmethod
    def _forge(query: Any) -> None:
        with query:
            query.reply(query.key_expr, b"forged")
