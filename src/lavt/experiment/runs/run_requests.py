"""The sweeping machine's end of remote runs: requests to the server, and the transfer of a record."""

from __future__ import annotations

import hashlib
import queue
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from msgspec.structs import replace

from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.security import build_authenticator, build_gateway
from lavt.assembly.zenoh import program_sessions
from lavt.clock import Clock, pause
from lavt.config import ClientConfig
from lavt.domain import NS_PER_MS, NS_PER_S, Now, RunOperation, RunRefusal, RunReply, RunRequest
from lavt.errors import BadMessage, WorkError
from lavt.node import Send
from lavt.transport.messages import RECORD_PART_BYTES, decode, encode
from lavt.transport.zenoh_link import ZenohLink
from lavt.transport.zenoh_session import quiet_logs

REPEAT_S = 1.0
"""A request without a reply is repeated after this time."""
ANSWER_LIMIT_S = 15.0
"""The connection counts as lost after this time without a reply."""
PART_PERIOD_NS = 12 * NS_PER_MS
"""The least time between two requests, because the server answers 100 a second."""
MAX_RECORD_BYTES = 4_000_000_000
FETCH_LIMIT_S = 3600.0
"""The time limit for the transfer of a record."""
MAX_WAITING = 64


class ConnectionLost(WorkError):
    """The server does not answer."""


class RunRefused(WorkError):
    """The server refuses a request; `refusal` says why."""

    def __init__(self, refusal: RunRefusal, reason: str) -> None:
        super().__init__(f"the server refuses: {reason}")
        self.refusal: RunRefusal = refusal


class RunRequests:
    """Requests of one client. `send` passes a `Send` to the network, from which `deliver` receives the replies."""

    def __init__(self, who: str, clock: Clock, instance: int) -> None:
        self.send: Callable[..., None] = lambda *_: None
        self.ignored = 0
        """Number of replies that were unreadable or to another request."""
        self.longest_wait_s = 0.0
        """The longest time that a request has waited for its reply."""
        self._who = who
        self.clock = clock
        self._instance = instance
        self._number = 0
        self._replies: queue.Queue[bytes] = queue.Queue(MAX_WAITING)

    def deliver(self, channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        """Take a message from the network; drop it if too many are waiting."""
        if channel == "run_reply":
            with suppress(queue.Full):
                self._replies.put_nowait(payload)

    def request(self, operation: RunOperation, run: int, *, settings: str = "", offset: int = 0) -> RunReply:
        """Send a request until a reply arrives; raise `RunRefused` or `ConnectionLost`."""
        self._number += 1
        with suppress(queue.Empty):  # what waits is not the reply to this request
            while True:
                self._replies.get_nowait()
        request = RunRequest(operation, self._who, self._instance, self._number, run, settings, offset)
        sent_ns = self.clock.now().mono_ns
        until_ns = sent_ns + round(ANSWER_LIMIT_S * NS_PER_S)
        while (now_ns := self.clock.now().mono_ns) < until_ns:
            self.send(Send("run", encode(request)))
            reply = self._reply(min(until_ns, now_ns + round(REPEAT_S * NS_PER_S)))
            if reply is not None:
                waited_s = (self.clock.now().mono_ns - sent_ns) / NS_PER_S
                self.longest_wait_s = max(self.longest_wait_s, waited_s)
            if reply is not None and reply.refusal:
                raise RunRefused(reply.refusal, reply.reason)
            if reply is not None:
                return reply
        raise ConnectionLost(
            f"the server has not answered for {ANSWER_LIMIT_S:.0f} s: is it running with experiment.remote_runs, and "
            "do the names and keys match?"
        )

    def _reply(self, until_ns: int) -> RunReply | None:
        """Return the reply to the last request, None if there is none in time."""
        while (wait_ns := until_ns - self.clock.now().mono_ns) > 0:
            with suppress(queue.Empty):
                payload = self._replies.get(timeout=wait_ns / NS_PER_S)
                try:
                    reply = decode(RunReply, payload)
                except BadMessage:
                    self.ignored += 1
                    continue
                if reply.number == self._number:
                    return replace(reply, reason=_printable(reply.reason), ending=_printable(reply.ending))
                self.ignored += 1
        return None


class RunConnection(RunRequests):
    """Requests over a Zenoh session of its own with the vehicle's router, signed if the config has a key."""

    def __init__(self, config: ClientConfig, clock: Clock) -> None:
        super().__init__(config.who, clock, MachineEntropy().number(64))
        authenticator = build_authenticator(config, clock.now().wall_ns)
        quiet_logs()
        self._link = ZenohLink(
            clock, side="client", settings=program_sessions(config)[-1], vehicle=config.vehicle_id, who=config.who
        )
        gateway = build_gateway(authenticator, self.deliver, self._link.send, lambda: (0, -1))
        self.send = gateway.send
        self._link.start(gateway.receive, queries_only=True)

    def __enter__(self) -> RunConnection:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._link.close()


def _printable(text: str) -> str:
    """Return a text of the server without control characters, which a terminal would execute."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def fetch_record(requests: RunRequests, run: int, finished: RunReply, path: Path) -> None:
    """Write the record of a finished run to `path`; raise `WorkError` if it is not the one that the server announced.

    `finished` is the server's reply with the record's size and digest.
    """
    if not 0 < finished.size <= MAX_RECORD_BYTES:
        raise WorkError(f"the server announces a record of {finished.size} bytes, which cannot be right")
    digest, size = hashlib.sha256(), 0
    until_ns = requests.clock.now().mono_ns + round(FETCH_LIMIT_S * NS_PER_S)
    with path.open("wb") as file:
        while size < finished.size:
            if requests.clock.now().mono_ns > until_ns:
                raise WorkError(
                    f"only {size} of the record's {finished.size} bytes arrived within {FETCH_LIMIT_S:.0f} s: set "
                    "record.video: false, or use a faster network"
                )
            part = requests.request("read", run, offset=size).data
            if len(part) != min(RECORD_PART_BYTES, finished.size - size):
                raise WorkError("the server sent a part of the record with a wrong length")
            file.write(part)
            digest.update(part)
            size += len(part)
            pause(PART_PERIOD_NS)
    if digest.digest() != finished.digest:
        raise WorkError("the record that arrived is not the one that the server announced: its digest differs")
