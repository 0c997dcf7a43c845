"""Test a node that runs in a process of its own; the tests run both ends in one process."""

# ruff: noqa: D102 (test helpers with short methods)

from __future__ import annotations

import multiprocessing
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, Now
from lavt.errors import WorkError
from lavt.node import WAKE, Message, Send, Stage
from lavt.nodes.payloads import StationaryStatus
from lavt.runtime.pipe import CAPACITY, Pipe
from lavt.runtime.realtime import RealRuntime
from lavt.runtime.remote_node import (
    FAILED_AFTER_CHECKS,
    FIRST_HEARTBEAT_CHECKS,
    LATE_NS,
    MAX_PENDING_PEERS,
    SILENT_AFTER_CHECKS,
    NodeHost,
    RemoteNodeProxy,
)

pytestmark = pytest.mark.usefixtures("own_switch_interval")

CLOCK = MachineClock()


def wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(2000):
        if condition():
            return
        pause(5 * NS_PER_MS)
    raise AssertionError("the condition was not met within 10 s")


class FakeOutputs:
    """A recorder and a link in one; it stores what is recorded and sent."""

    def __init__(self) -> None:
        self.written: list[tuple[str, Any]] = []
        self.sent: list[Send] = []

    def write(self, topic: str, payload: Any, _now: Now) -> None:
        self.written.append((topic, payload))

    def send(self, *sends: Send) -> None:
        self.sent += sends

    def recorded(self, topic: str) -> list[Any]:
        return [payload for channel, payload in self.written if channel == topic]


@dataclass
class FakeActuator:
    """A node with the actuator's name: it answers a request with the request's payload, and sends to its neighbours."""

    name: str = "actuator"
    counts: Counter[str] = field(default_factory=Counter)
    received: list[Message] = field(default_factory=list)

    @property
    def pipelines(self) -> Mapping[str, Sequence[Stage]]:
        return {"control": (("receive", self._receive),), "session": (("answer", self._answer),), WAKE: ()}

    def next_wake_ns(self) -> int | None:
        return None

    def _receive(self, message: Message, _now: Now) -> list[Send]:
        self.received.append(message)
        if message.payload == b"break":
            raise RuntimeError("failed on purpose")
        return [Send("rest", StationaryStatus(at_rest=True, active_operator=None)), Send("event", "received")]

    def _answer(self, message: Message, _now: Now) -> list[Send]:
        return [Send("session_reply", message.payload, message.peer)]


@dataclass
class Neighbour:
    """Another node of the same side, in the server's process."""

    name: str = "injection"
    counts: Counter[str] = field(default_factory=Counter)
    received: list[Any] = field(default_factory=list)

    @property
    def pipelines(self) -> Mapping[str, Sequence[Stage]]:
        return {"rest": (("receive", lambda message, _now: self.received.append(message.payload)),), WAKE: ()}

    def next_wake_ns(self) -> int | None:
        return None


@dataclass
class ConnectedEnds:
    """A node and its host at one end, and the server's runtime with the node's proxy at the other."""

    node: FakeActuator
    neighbour: Neighbour
    outputs: FakeOutputs
    proxy: RemoteNodeProxy
    server: RealRuntime
    host: NodeHost
    disconnected: threading.Event
    status: list[int]
    """The status of the node, as its only element."""
    silences: list[RealRuntime]
    """The argument of each call of `on_silent`."""


@contextmanager
def connect() -> Iterator[ConnectedEnds]:
    server_end, node_end = multiprocessing.Pipe()
    node, neighbour, outputs, disconnected, status = FakeActuator(), Neighbour(), FakeOutputs(), threading.Event(), [0]
    silences: list[RealRuntime] = []
    proxy = RemoteNodeProxy("actuator", server_end, heartbeat="state", on_silent=silences.append)
    server = RealRuntime(CLOCK, [neighbour], outputs, lambda: None, {"actuator": proxy})
    host = NodeHost(node_end, CLOCK, node, get_status=lambda: status[0], on_disconnect=disconnected.set)
    server.start({"zenoh": outputs})
    proxy.start(server)
    host.start()
    ends = ConnectedEnds(node, neighbour, outputs, proxy, server, host, disconnected, status, silences)
    try:
        yield ends
    finally:
        host.close()
        proxy.close(5)
        server.stop()


@pytest.mark.realtime
@pytest.mark.judges_times
def test_a_remote_node_receives_and_sends() -> None:
    """Messages reach the remote node with their arrival time; its sends reach nodes, links and the record."""
    with connect() as ends:
        arrived = CLOCK.now()
        ends.server.deliver("control", b"drive", arrived)
        wait_until(lambda: bool(ends.neighbour.received))
        assert [(message.payload, message.arrived) for message in ends.node.received] == [(b"drive", arrived)]
        assert ends.neighbour.received == [StationaryStatus(at_rest=True, active_operator=None)]
        assert ends.outputs.recorded("control") == [b"drive"], "recorded once, in the process with the links"
        wait_until(lambda: ends.outputs.recorded("event") == ["received"])


def test_threads_that_forward_requests_do_not_disturb_each_other() -> None:
    """Threads that forward unanswered requests at the same time cause no error.

    To provoke errors, each thread lets the others run whenever a built-in function returns.
    """
    server_end, node_end = multiprocessing.Pipe()
    proxy, errors = (
        RemoteNodeProxy("actuator", server_end, heartbeat="state", on_silent=lambda _: None),
        list[Exception](),
    )

    def forward() -> None:
        try:
            for _ in range(100):
                proxy.put(Message("session", b"", Now(0, 0), object()))
        except RuntimeError as error:
            errors.append(error)

    threading.setprofile(lambda _frame, event, _function: pause(1) if event == "c_return" else None)
    threads = [threading.Thread(target=forward) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    threading.setprofile(None)
    proxy.close(0)
    node_end.close()
    assert errors == []


def test_a_reply_goes_to_its_peer() -> None:
    """A reply of the remote node goes to the peer of its request."""
    with connect() as ends:
        alice, bob = object(), object()
        ends.server.deliver("session", b"of alice", CLOCK.now(), alice)
        ends.server.deliver("session", b"of bob", CLOCK.now(), bob)
        wait_until(lambda: len(ends.outputs.sent) == 2)
        assert [(send.payload, send.peer) for send in ends.outputs.sent] == [(b"of alice", alice), (b"of bob", bob)]


def test_a_blocked_reply_delays_neither_heartbeats_nor_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    """While a link blocks on a reply, heartbeats, messages and other nodes' messages are processed."""
    with connect() as ends:
        blocked, resumed = threading.Event(), threading.Event()
        send = ends.outputs.send

        def block_replies(*sends: Send) -> None:
            if any(reply.channel == "session_reply" for reply in sends):
                blocked.set()
                resumed.wait(20)
            send(*sends)

        monkeypatch.setattr(ends.outputs, "send", block_replies)
        for _ in range(2 * MAX_PENDING_PEERS):
            ends.server.deliver("session", b"?", CLOCK.now(), "alice")
        assert blocked.wait(10)
        beat(ends)
        ends.host.runtime.links["zenoh"].send(Send("state", b"a state"))
        wait_until(lambda: Send("state", b"a state") in ends.outputs.sent)
        ends.server.deliver("control", b"drive", CLOCK.now())
        wait_until(lambda: bool(ends.neighbour.received))
        assert ends.proxy._replies.qsize() <= MAX_PENDING_PEERS
        assert ends.server.failed is None
        resumed.set()


def test_the_status_is_reported_before_messages() -> None:
    """The remote node's status is reported before its messages are sent."""
    with connect() as ends:
        ends.status[0] = 7
        ends.server.deliver("session", b"?", CLOCK.now(), object())
        wait_until(lambda: bool(ends.outputs.sent))
        assert ends.proxy.status == 7


@pytest.mark.realtime
def test_a_late_command_between_the_processes_is_dropped() -> None:
    """Messages delayed by more than 60 ms between the processes are counted; commands are dropped, requests are not."""
    with connect() as ends:
        long_ago = CLOCK.now().later(-LATE_NS - NS_PER_MS)
        ends.server.deliver("control", b"stale", long_ago)
        ends.server.deliver("session", b"late", long_ago, "alice")
        wait_until(lambda: bool(ends.outputs.sent))
        assert ends.node.received == []
    (counts,) = [entry for entry in ends.outputs.recorded("counts") if entry["node"] == "actuator's process"]
    assert (counts["control_late"], counts["session_late"], counts["record_overflow"]) == (1, 1, 0)


def test_the_end_of_the_other_process_is_noticed() -> None:
    """The node's process is notified when the server's process closes the pipe."""
    with connect() as ends:
        ends.proxy._pipe.close(1)
        assert ends.disconnected.wait(10)


@pytest.mark.realtime
@pytest.mark.judges_times
def test_a_failing_remote_node_ends_the_run() -> None:
    """An error of the remote node ends the server's run with that error."""
    with connect() as ends:
        ends.server.deliver("control", b"break", CLOCK.now())
        wait_until(lambda: ends.host.runtime.failed is not None)
        ends.host.close()
        wait_until(lambda: ends.server.failed is not None)
        assert "failed on purpose" in str(ends.server.failed)


def test_the_end_of_the_nodes_process_ends_the_run() -> None:
    """The end of the node's process ends the server's run with an error."""
    with connect() as ends:
        ends.host._pipe.close(1)
        wait_until(lambda: ends.server.failed is not None)
        assert isinstance(ends.server.failed, WorkError)
        assert "ended" in str(ends.server.failed)


@pytest.fixture
def no_checker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the proxy's own checks, so that only the test checks heartbeats."""
    monkeypatch.setattr(RemoteNodeProxy, "_check_heartbeats", lambda _: None)


def beat(ends: ConnectedEnds) -> None:
    """Let the remote node record a state, and wait until the proxy has received it."""
    count = len(ends.outputs.recorded("state"))
    ends.host.runtime.record("state", b"", CLOCK.now())
    wait_until(lambda: len(ends.outputs.recorded("state")) > count)


@pytest.mark.usefixtures("no_checker")
def test_a_remote_node_without_a_heartbeat_fails_the_run() -> None:
    """Without heartbeats, first the silence is reported, then the run fails; a heartbeat in between prevents this."""
    with connect() as ends:
        for _ in range(3):
            beat(ends)
            for _ in range(FAILED_AFTER_CHECKS - 1):
                ends.proxy.check_heartbeat()
        assert ends.silences == [ends.server] * 3
        assert ends.server.failed is None
        ends.host.runtime.record("event", "alive, but without a state", CLOCK.now())
        wait_until(lambda: bool(ends.outputs.recorded("event")))
        ends.proxy.check_heartbeat()
        assert isinstance(ends.server.failed, WorkError)


@pytest.mark.usefixtures("no_checker")
def test_a_heartbeat_while_the_silence_is_reported_prevents_the_failure() -> None:
    """A node whose heartbeat arrives while its silence is reported has not failed."""
    with connect() as ends:
        beat(ends)
        ends.proxy._on_silent = lambda _: beat(ends)
        for _ in range(SILENT_AFTER_CHECKS):
            ends.proxy.check_heartbeat()
        assert ends.server.failed is None


@pytest.mark.usefixtures("no_checker")
def test_the_first_heartbeat_may_take_longer() -> None:
    """Before the first heartbeat a node has 30 s; then the run fails."""
    with connect() as ends:
        for _ in range(FIRST_HEARTBEAT_CHECKS - 1):
            ends.proxy.check_heartbeat()
        assert (ends.silences, ends.server.failed) == ([], None)
        ends.proxy.check_heartbeat()
        assert isinstance(ends.server.failed, WorkError)


def test_heartbeats_are_checked() -> None:
    """A proxy checks heartbeats by itself from its start on."""
    with connect() as ends:
        beat(ends)
        wait_until(lambda: ends.server.failed is not None)
        assert ends.silences == [ends.server]


@pytest.mark.parametrize("failing_step", ["send", "read", "receive"])
def test_an_error_in_one_direction_closes_the_pipe(failing_step: str) -> None:
    """An entry that cannot be sent, read or received closes the pipe at both ends."""
    server_end, node_end = multiprocessing.Pipe()
    server_closed, node_closed = threading.Event(), threading.Event()

    def fail(_entry: object) -> None:
        raise LookupError("failed on purpose")

    server_pipe, node_pipe = Pipe(server_end, lambda _: None, server_closed.set), Pipe(node_end, fail, node_closed.set)
    server_pipe.start()
    node_pipe.start()
    if failing_step == "read":
        server_end.send_bytes(b"no entry")
    else:
        server_pipe.send(threading.Lock() if failing_step == "send" else "an entry")
    assert node_closed.wait(10)
    node_pipe.close(1)
    assert server_closed.wait(10)
    server_pipe.close(1)


def test_the_end_of_a_server_that_never_started_is_noticed() -> None:
    """The node's process is notified if the server closes its end without having started."""
    server_end, node_end = multiprocessing.Pipe()
    disconnected = threading.Event()
    proxy = RemoteNodeProxy("actuator", server_end, heartbeat="state", on_silent=lambda _: None)
    host = NodeHost(node_end, CLOCK, FakeActuator(), get_status=lambda: 0, on_disconnect=disconnected.set)
    host.start()
    proxy.close(5)
    assert disconnected.wait(10)
    host.close()


@pytest.mark.realtime
def test_sending_without_a_reader_does_not_block() -> None:
    """If nothing reads from a pipe, sending does not block, and entries that do not fit are counted."""
    server_end, _node_end = multiprocessing.Pipe()
    pipe = Pipe(server_end, lambda _entry: None, lambda: None)
    pipe.start()
    for _ in range(4 * CAPACITY):
        pipe.send(bytes(1000))
    assert CAPACITY < pipe.dropped <= 3 * CAPACITY


def test_a_pipe_that_was_never_started_closes() -> None:
    """A pipe that was never started can be closed, which the other end notices."""
    server_end, node_end = multiprocessing.Pipe()
    proxy = RemoteNodeProxy("actuator", server_end, heartbeat="state", on_silent=lambda _: None)
    proxy.close(1)
    with pytest.raises(EOFError):
        node_end.recv_bytes()
    node_end.close()
