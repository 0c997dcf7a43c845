"""The shipped encrypted routers on the loopback, with a vehicle, an operator and attackers.

Vehicle, operator and attackers are plain Zenoh sessions without LAVT's gateway, so that only the routers protect
against the attackers. The sessions of vehicle and operator contain their routers, or have separate ones.
"""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from lavt.cli.router import parse_overrides
from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import Process, Processes
from lavt.transport.zenoh_link import CONTROL, STATE

BASE = "lavt/vehicle-1"
OPERATOR_KEYS = (f"{BASE}/session", f"{BASE}/netem", f"{BASE}/run")
"""The keys that only operators may query."""
QUERY_KEYS = (*OPERATOR_KEYS, f"{BASE}/info")
QUIC = "quic/127.0.0.1:0?mixed_rel=1"
ROUND_NS = 20 * NS_PER_MS
ROUNDS = 25
"""Messages are exchanged until this many commands, states and replies have arrived."""
LIMIT_S = 15.0
"""Time limit of an attack."""
LONG_COMMAND_BYTES = 5000
_INTRUDER_NUMBERS = itertools.count()


def make_keys(directory: Path, *arguments: str) -> None:
    """Run `lavt keys`."""
    subprocess.run([sys.executable, "-m", "lavt", "keys", str(directory), *arguments], check=True, capture_output=True)


def tls_changes(keys: Path, name: str, action: str) -> tuple[str, ...]:
    """Return the config changes for the keys of a router; `action` is "listen" or "connect"."""
    base = "transport.link.tls"
    return (
        f"{base}.root_ca_certificate={keys}/authority.pem",
        f"{base}.{action}_certificate={keys}/{name}.pem",
        f"{base}.{action}_private_key={keys}/{name}.key",
    )


def start_router(processes: Processes, name: str, file: str, *changes: str) -> Process:
    """Start `lavt router` with a shipped config and `--set` for each change."""
    set_options = [word for change in changes for word in ("--set", change)]
    return processes.start(name, "router", str(shipped(f"zenoh-configs/{file}")), *set_options)


def open_embedded_router(file: str, *changes: str) -> Any:
    """Open a session that is a router, with a shipped config and changes as for `lavt router`."""
    config = zenoh.Config.from_file(str(shipped(f"zenoh-configs/{file}")))
    for key, value in parse_overrides(list(changes)).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def quic_endpoint(router: Process) -> str:
    """Return the QUIC endpoint that other routers dial."""
    return str(next(locator for locator in router.wait_ready()["locators"] if locator.startswith("quic/")))


def udp_port(endpoint: str) -> int:
    """Return the UDP port of an endpoint."""
    return int(endpoint.partition("?")[0].rpartition(":")[2])


def open_session(endpoint: str, mode: str = "client", *, authority: Path | None = None, own: Path | None = None) -> Any:
    """Open a session at `endpoint` as a client or a router.

    `authority` is the certificate that the session trusts; `own` is its own certificate, whose key is next to it.
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


def direct_handler(callback: Callable[[Any], None]) -> Any:
    """Return a handler that is called in Zenoh's own thread."""
    return zenoh.handlers.Callback(callback, indirect=False)


class VehicleStandIn:
    """A stand-in for `lavt server` that receives commands, answers queries and publishes states."""

    def __init__(self, session: Any) -> None:
        self.commands: list[bytes] = []
        self.deleted = 0
        self.queries: list[bytes] = []
        self.session = session
        self._state = self.session.declare_publisher(f"{BASE}/state", **STATE)
        self.session.declare_subscriber(f"{BASE}/control", direct_handler(self._on_command))
        for key in QUERY_KEYS:
            self.session.declare_queryable(key, direct_handler(self._on_query))
        self._alive = self.session.liveliness().declare_token(f"{BASE}/alive/server-1")

    def publish_state(self) -> None:
        """Publish a state."""
        self._state.put(b"state")

    def _on_command(self, sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self.deleted += 1
        self.commands.append(sample.payload.to_bytes())

    def _on_query(self, query: Any) -> None:
        with query:
            if any(query.key_expr.intersects(zenoh.KeyExpr(key)) for key in OPERATOR_KEYS):
                self.queries.append(b"" if query.payload is None else query.payload.to_bytes())
            for key in QUERY_KEYS:
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, b"reply to " + key.rpartition("/")[2].encode())


class ClientStandIn:
    """A stand-in for `lavt client` that sends commands with a name, receives states and sends queries."""

    def __init__(self, session: Any, name: bytes) -> None:
        self.session = session
        self.name = name
        self.received: dict[str, list[bytes]] = {}
        self.replies: list[bytes] = []
        self._own_id = str(session.info.zid())
        self._control = session.declare_publisher(f"{BASE}/control", **CONTROL)
        self.subscribe(f"{BASE}/state")

    def subscribe(self, key: str) -> None:
        """Store the payloads that are published on a key."""
        payloads = self.received.setdefault(key, [])
        self.session.declare_subscriber(key, direct_handler(lambda sample: payloads.append(sample.payload.to_bytes())))

    def send_command(self) -> None:
        """Send a command."""
        self._control.put(self.name)

    def send_query(self, key: str) -> None:
        """Send a query and store the replies."""
        self.session.get(key, direct_handler(self._on_reply), payload=self.name, timeout=1.0)

    def _on_reply(self, reply: Any) -> None:
        if reply.ok is not None and self._own_id not in str(reply.ok.key_expr):  # a session also answers itself
            self.replies.append(reply.ok.payload.to_bytes())


@dataclass
class Site:
    """A vehicle and its operator, each with its own router, embedded or separate; the routers are linked."""

    keys: Path
    endpoint: str
    """The endpoint of the router that accepts links from outside: the vehicle's or the cloud's."""
    operator_socket: Path
    """The socket at which the operator's router listens."""
    vehicle: VehicleStandIn
    operator: ClientStandIn
    processes: Processes
    clock: MachineClock = field(default_factory=MachineClock)

    def intruder(self, name: str, mode: str) -> Intruder:
        """Return an intruder that dials with the certificate of `name`, from this site's authority."""
        own = self.keys / f"{name}.pem"
        return Intruder(open_session(self.endpoint, mode, authority=self.keys / "authority.pem", own=own))

    def exchange_messages(self, action: Callable[[], None] = lambda: None) -> None:
        """Send messages in rounds until `ROUNDS` of each kind have arrived; call `action` in each round."""
        commands, states, replies = (len(messages) for messages in self._arrived())
        limit_ns = self._limit_ns()
        while True:
            self._round(action)
            now_commands, now_states, now_replies = (len(messages) for messages in self._arrived())
            rounds = min(now_commands - commands, now_states - states, (now_replies - replies) // len(QUERY_KEYS))
            if rounds >= ROUNDS:
                return
            assert self.clock.now().mono_ns < limit_ns, f"only {rounds} rounds arrived in {LIMIT_S:g} s"

    def attack(self, intruder: Intruder, aims: set[str]) -> set[str]:
        """Let an intruder attack until it has achieved the effects `aims` or the time is over; return its effects."""
        limit_ns = self._limit_ns()
        while True:
            self._round(intruder.attempt)
            achieved = intruder.achieved(self)
            if achieved >= aims or self.clock.now().mono_ns >= limit_ns:
                return achieved

    def _limit_ns(self) -> int:
        return self.clock.now().mono_ns + round(LIMIT_S * NS_PER_S)

    def _round(self, action: Callable[[], None]) -> None:
        action()
        self.operator.send_command()
        self.vehicle.publish_state()
        for key in QUERY_KEYS:
            self.operator.send_query(key)
        pause(ROUND_NS)

    def _arrived(self) -> tuple[list[bytes], list[bytes], list[bytes]]:
        return (
            [command for command in self.vehicle.commands if command == self.operator.name],
            [state for state in self.operator.received[f"{BASE}/state"] if state == b"state"],
            [reply for reply in self.operator.replies if reply.startswith(b"reply to ")],
        )


class Intruder(ClientStandIn):
    """An attacker with a session: `attempt` sends all kinds of messages, `achieved` returns their effects."""

    def __init__(self, session: Any) -> None:
        super().__init__(session, b"intruder %d" % next(_INTRUDER_NUMBERS))  # the last intruder's messages may be late
        for key in ("**", "lavt/**", "lavt/*/*", f"{BASE}/control"):
            self.subscribe(key)
        self.alive: list[str] = []
        session.liveliness().declare_subscriber(
            f"{BASE}/alive/*", direct_handler(lambda sample: self.alive.append(str(sample.key_expr))), history=True
        )
        for key in (*QUERY_KEYS, "lavt/**"):
            session.declare_queryable(key, direct_handler(self._forge), complete=True)

    def attempt(self) -> None:
        """Send one message of each kind."""
        self.send_command()
        for key in ("**", "lavt/**", "lavt/*/control", f"{BASE}/*"):
            self.session.put(key, b"wildcard")
        self.session.delete(f"{BASE}/control")
        self.session.put(f"{BASE}/control", b"long" * (LONG_COMMAND_BYTES // 4))
        self.session.put(f"{BASE}/state", b"forged")
        for key in (*OPERATOR_KEYS, "lavt/*/info", "lavt/**", "@/**"):
            self.send_query(key)

    def achieved(self, site: Site) -> set[str]:
        """Return the effects on vehicle and operator, and the kinds of messages that were received."""
        payloads_on_other_keys = [
            payload for key, payloads in self.received.items() for payload in payloads if key != f"{BASE}/state"
        ]
        replies = set(self.replies) - {b"forged"}
        effects = {
            "commands": self.name in site.vehicle.commands,
            "wildcard commands": b"wildcard" in site.vehicle.commands,
            "deletes": site.vehicle.deleted > 0,
            "long commands": any(len(command) >= LONG_COMMAND_BYTES for command in site.vehicle.commands),
            "queries": self.name in site.vehicle.queries,
            "session": b"reply to session" in replies,
            "netem": b"reply to netem" in replies,
            "run": b"reply to run" in replies,
            "info": b"reply to info" in replies,
            "the routers' own state": bool(
                replies - {b"reply to session", b"reply to netem", b"reply to info", b"reply to run"}
            ),
            "forged state": any(state != b"state" for state in site.operator.received[f"{BASE}/state"]),
            "forged replies": b"forged" in site.operator.replies,
            "state": b"state" in self.received[f"{BASE}/state"],
            "others' commands": site.operator.name in payloads_on_other_keys,
            "alive": f"{BASE}/alive/server-1" in self.alive,
        }
        return {effect for effect, occurred in effects.items() if occurred}

    def close(self) -> None:
        """Close the session."""
        self.session.close()

    @staticmethod
    def _forge(query: Any) -> None:
        with query:
            query.reply(query.key_expr, b"forged")
