"""Commands, states and session requests over Zenoh.

Each side has a router, and the routers are linked to each other. The session of a side is this router itself, or a
session with a separate router. Safety does not depend on Zenoh: after an outage Zenoh can deliver commands that are
seconds old, and it reports a lost session only when the lease has expired.
"""

from __future__ import annotations

import itertools
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, Literal

import zenoh

from lavt.clock import Clock
from lavt.domain import Now
from lavt.errors import UserError
from lavt.node import Send
from lavt.transport.messages import NAME
from lavt.transport.router_check import RouterCheck, Routers, end_process_later, parse_locators, parse_routers
from lavt.transport.zenoh_config import SessionSettings, check_endpoints, check_tls_files, error_text
from lavt.transport.zenoh_session import (
    RouterUnreachable,
    close_session,
    load_zenoh_config,
    open_router,
    open_zenoh,
    router_reports,
)

Deliver = Callable[[str, Any, Now, Any], None]
"""Takes (channel, payload, arrived, peer) of each received message."""

REPLY_TIMEOUT_S = 2.0
RETRY_S = 1.0
FIRST_LINK_LIMIT_S, FIRST_LINK_POLL_S = 0.5, 0.005
"""How long a client whose session is a router waits at its start for the server, and how often it looks. On a fast
network this takes 0.1 s, the time after which Zenoh's routers compute their routes."""
OTHER_ROUTES_S = 0.02
"""Time in which the server's router also has computed its routes, which it does not announce."""
REPLY_CHANNELS = {"session": "session_reply", "netem": "netem_reply", "info": "info_reply", "run": "run_reply"}
"""The channel of the replies for each channel of queries. The channel of a query is the last part of its key."""
DRIVE_QUERIES = ("session", "netem", "info")
"""The queries that every server answers. Only a server that allows remote runs also answers `run`."""
QUERY_CHANNELS = {reply: query for query, reply in REPLY_CHANNELS.items()}
RECEIVE_RING_LENGTH = 256
"""The number of received messages that can wait; if there are more, the oldest is dropped. Zenoh's threads write to
this ring without Python's lock, so that a flood does not queue in sockets."""
MAX_PENDING_QUERIES = 64
"""The number of queries per channel that can wait for a reply; if there are more, the oldest is dropped. A limit is
necessary, because queries that cannot be decoded never get a reply."""
CONTROL: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.REAL_TIME,
    "express": True,
    "reliability": zenoh.Reliability.BEST_EFFORT,
}
"""Zenoh's settings for commands. A late command is worthless, so a command has the highest priority, is never resent or
batched, and is dropped if it cannot be sent at once."""
STATE: dict[str, Any] = {**CONTROL, "priority": zenoh.Priority.INTERACTIVE_HIGH}
"""Zenoh's settings for states."""


def check_name(subject: str, name: str) -> str:
    """Return `name` if it can be part of a key; raise `UserError` that names `subject` otherwise."""
    if not NAME.match(name):
        raise UserError(
            f"{subject} {name!r} cannot be part of a Zenoh key: use 1 to 32 letters, digits, _ or -, not _ or - first"
        )
    return name


def _zenoh_callback(handle: Callable[[str, Any], None], channel: str) -> Callable[[Any], None]:
    """Return a callback for Zenoh's threads that treats an error in `handle` like the error of a Python thread."""

    def call(received: Any) -> None:
        try:
            handle(channel, received)
        except BaseException as error:
            details = (type(error), error, error.__traceback__, threading.current_thread())
            threading.excepthook(threading.ExceptHookArgs(details))

    return call


def _discard(_channel: str, _payload: bytes, _arrived: Now, _peer: object) -> None:
    """Ignore a message that arrives before the link is started."""


class ZenohLink:
    """A Zenoh session of one side, which publishes, subscribes, and sends or answers queries.

    `who` names this session in its liveliness token. Raises `UserError` for an invalid config, if a session that is a
    router cannot listen, and if no router answers. With `waiting`, a missing router is not an error: `start` calls
    `waiting` with the reason and opens the session in the background as soon as a router answers. Messages that are
    sent before then are counted as not sent. A session that is a router dials other routers in the background.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        side: Literal["server", "client"],
        settings: SessionSettings,
        vehicle: str,
        who: str,
        waiting: Callable[[str], None] | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._clock = clock
        self._deliver: Deliver = _discard
        self._answers_runs_only = False
        self._side = side
        self._base = f"lavt/{check_name('the vehicle', vehicle)}"
        self._who = check_name("the client", who)
        self._queries: dict[str, dict[int, zenoh.Query]] = {channel: {} for channel in REPLY_CHANNELS}
        self._queries_lock = threading.Lock()
        self._query_numbers = itertools.count()
        self._session: Any = None
        self._publisher: Any = None
        self._declared: list[Any] = []
        self._closing = threading.Event()
        self._opener: threading.Thread | None = None
        self._listener: threading.Thread | None = None
        self._waiting = waiting
        self._waiting_reason = ""
        self._check: RouterCheck | None = None
        self._dials = settings.is_router and side == "client"
        if settings.is_router:
            self._session = open_router(settings.path, settings.changes, must_listen=False)
            self._check = RouterCheck(partial(router_reports, self._session))
        else:
            self._open_session(settings)

    def _open_session(self, settings: SessionSettings) -> None:
        self._config = load_zenoh_config(settings.path, settings.changes)
        endpoints = check_endpoints(self._config, "zenoh.router")
        check_tls_files(self._config)
        try:
            self._session = open_zenoh(self._config)
        except zenoh.ZError as error:
            self._waiting_reason = f"no router answers at {endpoints}: {settings.advice} ({error_text(error)})"
            if self._waiting is None:
                raise RouterUnreachable(self._waiting_reason) from error

    def locators(self) -> list[str]:
        """Return the endpoints at which a session that is a router listens."""
        return parse_locators(router_reports(self._session))

    def start(self, deliver: Deliver, *, queries_only: bool = False, answers_runs_only: bool = False) -> None:
        """Start to send and to receive; threads of the link call `deliver`.

        With `queries_only` the link sends queries and receives replies, but does not publish, subscribe or answer. With
        `answers_runs_only` it answers the queries `run`, and nothing else.
        """
        self._deliver = deliver
        self._answers_runs_only = answers_runs_only
        if self._dials:
            self._await_server()
        if queries_only:
            return
        if self._check is not None:
            threading.Thread(target=self._check.repeat, args=(self._closing,), name="zenoh check", daemon=True).start()
        if self._session is not None:
            self._declare(self._session)
        elif self._waiting is not None:
            self._waiting(self._waiting_reason)
            self._opener = threading.Thread(target=self._open_later, name="zenoh opener", daemon=True)
            self._opener.start()

    def _await_server(self) -> None:
        """Wait for a server that answers queries, so that the first request is not lost; return without one, too."""
        queriers = [self._session.declare_querier(f"{self._base}/{channel}") for channel in ("session", "run")]
        for _ in range(round(FIRST_LINK_LIMIT_S / FIRST_LINK_POLL_S)):
            if any(querier.matching_status.matching for querier in queriers):
                self._closing.wait(OTHER_ROUTES_S)
                break
            self._closing.wait(FIRST_LINK_POLL_S)
        for querier in queriers:
            querier.undeclare()

    def _open_later(self) -> None:
        """Try to open the session until it succeeds; each attempt takes at most the config's open_timeout."""
        while not self._closing.wait(RETRY_S):
            try:
                session = open_zenoh(self._config)
            except zenoh.ZError:
                self.counts["router_unreachable"] += 1
                continue
            try:
                self._declare(session)
            except BaseException:  # the error of this thread ends the process, which must not wait for the session
                self._closing.set()
                self._close(session)
                raise
            self._session = session
            return

    def _declare(self, session: zenoh.Session) -> None:
        if self._answers_runs_only:
            self._answer(session, "run")
            return
        received, sent, qos = ("control", "state", STATE) if self._side == "server" else ("state", "control", CONTROL)
        self._publisher = session.declare_publisher(f"{self._base}/{sent}", **qos)
        ring: Any = zenoh.handlers.RingChannel(RECEIVE_RING_LENGTH)
        subscriber: Any = session.declare_subscriber(f"{self._base}/{received}", ring)
        self._declared.append(subscriber)
        self._listener = threading.Thread(
            target=self._listen, args=(received, subscriber.handler), name=f"zenoh {received}", daemon=True
        )
        self._listener.start()
        self._answer(session, *(DRIVE_QUERIES if self._side == "server" else ()))
        self._declared.append(session.liveliness().declare_token(f"{self._base}/alive/{self._who}"))

    def _answer(self, session: zenoh.Session, *channels: str) -> None:
        for channel in channels:
            on_query: Any = zenoh.handlers.Callback(_zenoh_callback(self._on_query, channel), indirect=False)
            self._declared.append(session.declare_queryable(f"{self._base}/{channel}", on_query))

    def send(self, *sends: Send) -> None:
        """Send messages of this side. A message that cannot be sent now is counted and dropped: a newer one follows."""
        for send in sends:
            self._send(send)

    def _send(self, send: Send) -> None:
        try:
            if self._session is None:  # no router has answered yet
                self.counts[f"{send.channel}_not_sent"] += 1
            elif send.channel in REPLY_CHANNELS:
                self._query(send.channel, send.payload)
            elif send.channel in QUERY_CHANNELS:
                self._reply(QUERY_CHANNELS[send.channel], send.peer, send.payload)
            else:
                self._publisher.put(send.payload)
        except zenoh.ZError:
            self.counts[f"{send.channel}_not_sent"] += 1

    def routers(self) -> Routers | None:
        """Query the routers for their links and versions; return None if this session's router does not answer."""
        own = {str(zid) for zid in self._session.info.routers_zid()}
        return parse_routers(router_reports(self._session, "@/*/router"), own)

    def close(self) -> None:
        """Close the session; a process with an open session would not end."""
        self._closing.set()
        if self._check is not None and self._check.has_failed:
            end_process_later()
        if self._opener is not None:
            self._opener.join()
        if self._session is not None:
            self._close(self._session)

    def _close(self, session: zenoh.Session) -> None:
        for declared in self._declared:
            with suppress(zenoh.ZError):  # the session has been closed already
                declared.undeclare()
        if self._listener is not None:
            self._listener.join()
        close_session(session)

    def _listen(self, channel: str, ring: Any) -> None:
        """Deliver received messages until the subscriber is undeclared."""
        while True:
            try:
                sample = ring.recv()
            except zenoh.ZError:
                if self._closing.is_set():
                    return
                raise
            self._deliver(channel, sample.payload.to_bytes(), self._clock.now(), None)

    def _query(self, channel: str, payload: bytes) -> None:
        on_reply: Any = zenoh.handlers.Callback(_zenoh_callback(self._on_reply, channel), indirect=False)
        self._session.get(
            f"{self._base}/{channel}",
            on_reply,
            payload=payload,
            timeout=REPLY_TIMEOUT_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            target=zenoh.QueryTarget.ALL,  # the nearest queryable might only pretend to be the vehicle
        )

    def _on_reply(self, channel: str, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._deliver(REPLY_CHANNELS[channel], reply.ok.payload.to_bytes(), self._clock.now(), None)
        else:
            self.counts[f"{channel}_unanswered"] += 1

    def _on_query(self, channel: str, query: zenoh.Query) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        number = next(self._query_numbers)
        with self._queries_lock:
            pending = self._queries[channel]
            pending[number] = query
            oldest = pending.pop(next(iter(pending))) if len(pending) > MAX_PENDING_QUERIES else None
        if oldest is not None:
            oldest.drop()
        self._deliver(channel, payload, self._clock.now(), number)

    def _reply(self, channel: str, number: int, payload: bytes) -> None:
        with self._queries_lock:
            query = self._queries[channel].pop(number, None)
        if query is not None:
            query.reply(f"{self._base}/{channel}", payload)
            query.drop()
