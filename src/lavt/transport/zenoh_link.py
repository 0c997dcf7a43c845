"""Commands, state and session over Zenoh; the only module that knows it.

Each side has a session to a router on its own machine; the routers talk to each other. Zenoh is not trusted with
safety: after an outage it may deliver seconds of old commands, and its liveliness is as slow as its lease.
"""

from __future__ import annotations

import functools
import itertools
import json
import re
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import zenoh

from lavt.clock import Clock
from lavt.domain import Now
from lavt.errors import UserError, WorkError
from lavt.node import Send
from lavt.transport.messages import NAME

Deliver = Callable[[str, Any, Now, Any], None]

REPLY_TIMEOUT_S = 2.0
ROUTER_READY_S = 5.0
RETRY_S = 1.0
PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws")
"""What an endpoint with a host and a port may begin with; Zenoh itself calls a wrong one unreachable."""
PROTOCOLS_OF_PATHS = ("unixsock-stream", "unixpipe", "vsock", "serial")
ANSWERS = {"session": "session_reply", "netem": "netem_reply"}
"""The queries, by the last part of their keys, and what answers them."""
REQUESTED = {answer: query for query, answer in ANSWERS.items()}
ARRIVING_KEPT = 256
"""So many messages wait to be heard; of more the oldest goes. Zenoh's threads put down what comes and never wait for
Python's lock, so that a flood makes no queue in sockets."""
MAX_PENDING_QUERIES = 64
"""So many queries of each kind wait for an answer; nobody answers what cannot be read, and then the oldest goes."""
CONTROL: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.REAL_TIME,
    "express": True,
    "reliability": zenoh.Reliability.BEST_EFFORT,
}
"""A command that is late is worthless: never re-sent, never blocked, never batched, before everything else."""
STATE: dict[str, Any] = {**CONTROL, "priority": zenoh.Priority.INTERACTIVE_HIGH}


def quiet_logs() -> None:
    """Let Zenoh log errors only (it logs to standard output), unless RUST_LOG says otherwise."""
    zenoh.init_log_from_env_or("error")


def check_name(what: str, name: str) -> str:
    """Return `name` if it may be part of a key; raises `UserError` otherwise, and says what `what` may be called."""
    if not NAME.match(name):
        raise UserError(
            f"{what} {name!r} cannot be part of a Zenoh key: use 1 to 32 letters, digits, _ or -, not _ or - first"
        )
    return name


def _load(path: Path, overrides: Mapping[str, Any]) -> zenoh.Config:
    """Read a config file and set `overrides` (keys with slashes) in it."""
    if not path.is_file():
        raise UserError(f"there is no Zenoh config {path}: the shipped ones are in zenoh-configs/")
    try:
        config = zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise UserError(f"{path} is not a Zenoh config: {_plain(error)}") from error
    for key, value in overrides.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except (zenoh.ZError, TypeError, ValueError) as error:
            raise UserError(
                f"{key.replace('/', '.')} cannot be {value!r} in a Zenoh config: {_plain(error)}"
            ) from error
    return config


def _plain(error: Exception) -> str:
    """Error text of Zenoh in one line, without the places in its own source and the names of its own types."""
    text = " ".join(re.sub(r" at /\S+\.rs:\d+\.?", "", str(error)).split())
    text = re.sub(
        r"(?:Json5Err\()?Message \{ msg: \"(.*)\", location: .*? line: (\d+), column: (\d+) .*", r"\1 (line \2)", text
    )
    return re.sub(r"^Str\(\"(.*)\"\)$", r"\1", text)


def _listens(config: zenoh.Config) -> bool:
    """Whether the config of a router names where it listens; what it does not name Zenoh fills in with everywhere."""
    endpoints = config.get_json("listen/endpoints")
    if endpoints == zenoh.Config().get_json("listen/endpoints"):
        return False
    named = json.loads(endpoints)
    return bool(named.get("router") if isinstance(named, dict) else named)


def _check_endpoints(config: zenoh.Config) -> Any:
    """Give the endpoints that a session connects to; raises `UserError` for one that nobody could ever answer at."""
    endpoints = json.loads(config.get_json("connect/endpoints"))
    for endpoint in endpoints if isinstance(endpoints, list) else []:
        protocol, _, address = endpoint.partition("/")
        port = re.split(r"[?#]", address)[0].rpartition(":")[2]
        if protocol in PROTOCOLS_OF_PATHS or (protocol in PROTOCOLS and port.isdecimal() and 0 < int(port) < 65_536):
            continue
        raise UserError(
            f"zenoh.router cannot be {endpoint!r}: write PROTOCOL/HOST:PORT with one of {', '.join(PROTOCOLS)}"
        )
    return endpoints


class Router:
    """A Zenoh router in this process, from a config file with `mode: "router"`."""

    def __init__(self, path: Path, overrides: Mapping[str, Any]) -> None:
        config = _load(path, overrides)
        if json.loads(config.get_json("mode")) != "router":
            raise UserError(f'{path} is not the config of a router: it must say mode: "router"')
        if not _listens(config):
            raise UserError(f"{path} names no listen endpoints; without them Zenoh would listen on all interfaces")
        if not json.loads(config.get_json("adminspace/enabled")):
            raise UserError(
                f"{path} must say adminspace: {{ enabled: true }}, or the router cannot tell where it listens"
            )
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise UserError(f"the router of {path} does not start: {_plain(error)}; name other endpoints") from error

    def locators(self) -> list[str]:
        """Where it listens, with the real port where the config said 0."""
        selector = f"@/{self._session.info.zid()}/router"
        for reply in self._session.get(selector, timeout=ROUTER_READY_S):
            if reply.ok is not None:
                locators: list[str] = json.loads(reply.ok.payload.to_string())["locators"]
                return locators
        raise WorkError(f"the router does not tell within {ROUTER_READY_S:.0f} s where it listens")

    def close(self) -> None:
        """Stop routing."""
        self._session.close()


class Routers(NamedTuple):
    """What the router of a session tells."""

    linked: int
    """How many other routers it has a link to."""
    versions: tuple[str, ...]
    """Zenoh's, of every router that tells it: its own first."""


class ZenohLink:
    """One side's session: publishes and subscribes what the side sends and hears, and carries the session query.

    Raises `UserError` for a config that cannot work and, where no router answers, too. With `waiting`, `start` calls
    that with the reason instead and opens the session in the background as soon as a router answers; what is to be
    sent before then is counted as not sent.
    """

    def __init__(
        self,
        clock: Clock,
        deliver: Deliver,
        *,
        side: Literal["server", "client"],
        path: Path,
        router: str,
        vehicle: str,
        who: str,
        waiting: Callable[[str], None] | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._clock = clock
        self._deliver = deliver
        self._side = side
        self._base = f"lavt/{check_name('the vehicle', vehicle)}"
        self._who = check_name("the client", who)
        self._queries: dict[str, dict[int, zenoh.Query]] = {channel: {} for channel in ANSWERS}
        self._queries_lock = threading.Lock()
        self._number = itertools.count()
        self._config = _load(path, {"connect/endpoints": [router]} if router else {})
        endpoints = _check_endpoints(self._config)
        self._session: Any = None
        self._publisher: Any = None
        self._declared: list[Any] = []
        self._closing = threading.Event()
        self._opener: threading.Thread | None = None
        self._listener: threading.Thread | None = None
        self._waiting = waiting
        self._waits_reason = ""
        try:
            self._session = zenoh.open(self._config)
        except zenoh.ZError as error:
            self._waits_reason = (
                f"no router answers at {endpoints}: start one with `lavt router FILE.json5`, or name another "
                f"({_plain(error)})"
            )
            if waiting is None:
                raise UserError(self._waits_reason) from error

    def start(self) -> None:
        """Begin to send and to hear; from here on messages are delivered."""
        if self._session is not None:
            self._declare(self._session)
        elif self._waiting is not None:
            self._waiting(self._waits_reason)
            self._opener = threading.Thread(target=self._open_later, name="zenoh opener", daemon=True)
            self._opener.start()

    def _open_later(self) -> None:
        """Try again and again; one try takes at most the config's open_timeout."""
        while not self._closing.wait(RETRY_S):
            try:
                session = zenoh.open(self._config)
            except zenoh.ZError:
                self.counts["router_unreachable"] += 1
            else:
                self._declare(session)
                self._session = session
                return

    def _declare(self, session: zenoh.Session) -> None:
        heard, said, qos = ("control", "state", STATE) if self._side == "server" else ("state", "control", CONTROL)
        self._publisher = session.declare_publisher(f"{self._base}/{said}", **qos)
        arriving: Any = session.declare_subscriber(f"{self._base}/{heard}", zenoh.handlers.RingChannel(ARRIVING_KEPT))
        self._declared.append(arriving)
        self._listener = threading.Thread(
            target=self._listen, args=(heard, arriving.handler), name=f"zenoh {heard}", daemon=True
        )
        self._listener.start()
        for channel in ANSWERS if self._side == "server" else ():
            requested: Any = zenoh.handlers.Callback(functools.partial(self._requested, channel), indirect=False)
            self._declared.append(session.declare_queryable(f"{self._base}/{channel}", requested))
        self._declared.append(session.liveliness().declare_token(f"{self._base}/alive/{self._who}"))

    def send(self, *sends: Send) -> None:
        """Carry messages of this side; what cannot be sent now is counted, for there is always a newer one."""
        for send in sends:
            self._send(send)

    def _send(self, send: Send) -> None:
        try:
            if self._session is None:  # no router has answered yet
                self.counts[f"{send.channel}_not_sent"] += 1
            elif send.channel in ANSWERS:
                self._ask(send.channel, send.payload)
            elif send.channel in REQUESTED:
                self._reply(REQUESTED[send.channel], send.peer, send.payload)
            else:
                self._publisher.put(send.payload)
        except zenoh.ZError:
            self.counts[f"{send.channel}_not_sent"] += 1

    def routers(self) -> Routers | None:
        """Ask the routers what they are linked to; None where that of this session does not tell."""
        own = {str(zid) for zid in self._session.info.routers_zid()}
        told = [
            json.loads(reply.ok.payload.to_string())
            for reply in self._session.get("@/*/router", timeout=REPLY_TIMEOUT_S)
            if reply.ok is not None
        ]
        told.sort(key=lambda router: router["zid"] not in own)
        if not told or told[0]["zid"] not in own:
            return None
        linked = sum(session["whatami"] == "router" for session in told[0]["sessions"])
        return Routers(linked, tuple(router["version"].partition("-")[0] for router in told))

    def close(self) -> None:
        """Leave: without it the process would not end."""
        self._closing.set()
        if self._opener is not None:
            self._opener.join()
        if self._session is None:
            return
        for declared in self._declared:
            declared.undeclare()
        if self._listener is not None:
            self._listener.join()
        self._session.close()

    def _listen(self, channel: str, arriving: Any) -> None:
        """Deliver what arrives until it is undeclared."""
        while True:
            try:
                sample = arriving.recv()
            except zenoh.ZError:
                return
            self._deliver(channel, sample.payload.to_bytes(), self._clock.now(), None)

    def _ask(self, channel: str, payload: bytes) -> None:
        answered: Any = zenoh.handlers.Callback(functools.partial(self._answered, channel), indirect=False)
        self._session.get(
            f"{self._base}/{channel}", answered, payload=payload, timeout=REPLY_TIMEOUT_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            target=zenoh.QueryTarget.ALL,  # the nearest alone might be somebody who only says that he is the vehicle
        )  # fmt: skip

    def _answered(self, channel: str, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._deliver(ANSWERS[channel], reply.ok.payload.to_bytes(), self._clock.now(), None)
        else:
            self.counts[f"{channel}_unanswered"] += 1

    def _requested(self, channel: str, query: zenoh.Query) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        number = next(self._number)
        with self._queries_lock:
            kept = self._queries[channel]
            kept[number] = query
            oldest = kept.pop(next(iter(kept))) if len(kept) > MAX_PENDING_QUERIES else None
        if oldest is not None:
            oldest.drop()
        self._deliver(channel, payload, self._clock.now(), number)

    def _reply(self, channel: str, number: int, payload: bytes) -> None:
        with self._queries_lock:
            query = self._queries[channel].pop(number, None)
        if query is not None:
            query.reply(f"{self._base}/{channel}", payload)
            query.drop()
