"""A node in a process of its own, both ends here: what goes through the pipe, and what is kept out of it."""

# ruff: noqa: D102 (helpers of tests: short methods say themselves what they do)

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
from lavt.node import WAKE, Hop, Message, Send
from lavt.nodes.payloads import StationaryStatus
from lavt.runtime.pipe import CAPACITY, Pipe
from lavt.runtime.realtime import RealRuntime
from lavt.runtime.remote_node import LATE_NS, NodeHost, RemoteNodeProxy

pytestmark = pytest.mark.usefixtures("own_switch_interval")

CLOCK = MachineClock()


def wait_until(what: Callable[[], bool]) -> None:
    for _ in range(2000):
        if what():
            return
        pause(5 * NS_PER_MS)
    raise AssertionError("it did not come true within 10 s")


class Notes:
    """A recorder, or a link, that keeps what it gets."""

    def __init__(self) -> None:
        self.written: list[tuple[str, Any]] = []
        self.sent: list[Send] = []

    def write(self, topic: str, payload: Any, _now: Now) -> None:
        self.written.append((topic, payload))

    def send(self, *sends: Send) -> None:
        self.sent += sends

    def of(self, topic: str) -> list[Any]:
        return [payload for channel, payload in self.written if channel == topic]


@dataclass
class Echo:
    """An "actuator" that answers what it is asked, and tells its neighbours."""

    name: str = "actuator"
    counts: Counter[str] = field(default_factory=Counter)
    heard: list[Message] = field(default_factory=list)

    @property
    def chains(self) -> Mapping[str, Sequence[Hop]]:
        return {"control": (("hear", self._hear),), "session": (("answer", self._answer),), WAKE: ()}

    def next_wake_ns(self) -> int | None:
        return None

    def _hear(self, message: Message, _now: Now) -> list[Send]:
        self.heard.append(message)
        if message.payload == b"break":
            raise RuntimeError("broken on purpose")
        return [Send("rest", StationaryStatus(at_rest=True, active_operator=None)), Send("event", "heard")]

    def _answer(self, message: Message, _now: Now) -> list[Send]:
        return [Send("session_reply", message.payload, message.peer)]


@dataclass
class Neighbour:
    """The node beside it, at the other end."""

    name: str = "injection"
    counts: Counter[str] = field(default_factory=Counter)
    heard: list[Any] = field(default_factory=list)

    @property
    def chains(self) -> Mapping[str, Sequence[Hop]]:
        return {"rest": (("hear", lambda message, _now: self.heard.append(message.payload)),), WAKE: ()}

    def next_wake_ns(self) -> int | None:
        return None


@dataclass
class Rig:
    """Both ends in one process."""

    node: Echo
    neighbour: Neighbour
    notes: Notes
    there: RemoteNodeProxy
    main: RealRuntime
    here: NodeHost
    parted: threading.Event
    number: list[int]


@contextmanager
def rig() -> Iterator[Rig]:
    ours, theirs = multiprocessing.Pipe()
    node, neighbour, notes, parted, number = Echo(), Neighbour(), Notes(), threading.Event(), [0]
    there = RemoteNodeProxy("actuator", ours)
    main = RealRuntime(CLOCK, [neighbour], notes, lambda: None, {"actuator": there})
    here = NodeHost(theirs, CLOCK, node, note=lambda: number[0], parted=parted.set)
    main.start({"zenoh": notes})
    there.start(main)
    here.start()
    both = Rig(node, neighbour, notes, there, main, here, parted, number)
    try:
        yield both
    finally:
        here.close()
        there.close(5)
        main.stop()


@pytest.mark.realtime
@pytest.mark.judges_times
def test_a_node_elsewhere_hears_and_is_heard() -> None:
    """Messages reach the node with their time of arrival; what it tells reaches neighbours, links and the record."""
    with rig() as both:
        arrived = CLOCK.now()
        both.main.deliver("control", b"drive", arrived)
        wait_until(lambda: bool(both.neighbour.heard))
        assert [(each.payload, each.arrived) for each in both.node.heard] == [(b"drive", arrived)]
        assert both.neighbour.heard == [StationaryStatus(at_rest=True, active_operator=None)]
        assert both.notes.of("control") == [b"drive"], "written down once, where the links are"
        wait_until(lambda: both.notes.of("event") == ["heard"])


def test_an_answer_finds_who_requested() -> None:
    """A peer, which nothing but its link understands, stays in its process; the answer is for it."""
    with rig() as both:
        alice, bob = object(), object()
        both.main.deliver("session", b"of alice", CLOCK.now(), alice)
        both.main.deliver("session", b"of bob", CLOCK.now(), bob)
        wait_until(lambda: len(both.notes.sent) == 2)
        assert [(send.payload, send.peer) for send in both.notes.sent] == [(b"of alice", alice), (b"of bob", bob)]


def test_what_is_in_force_is_known_before_its_answer_leaves() -> None:
    """What the node notes is told before whatever it sends by a link."""
    with rig() as both:
        both.number[0] = 7
        both.main.deliver("session", b"?", CLOCK.now(), object())
        wait_until(lambda: bool(both.notes.sent))
        assert both.there.noted == 7


@pytest.mark.realtime
def test_a_command_that_was_late_between_the_processes_is_dropped() -> None:
    """A command that came more than 60 ms ago is counted and not handed to the node; a query is, as if it came now."""
    with rig() as both:
        long_ago = CLOCK.now().later(-LATE_NS - NS_PER_MS)
        both.main.deliver("control", b"stale", long_ago)
        both.main.deliver("session", b"late", long_ago, "alice")
        wait_until(lambda: bool(both.notes.sent))
        assert both.node.heard == []
    (counted,) = [each for each in both.notes.of("counts") if each["node"] == "actuator's process"]
    assert (counted["control_late"], counted["session_late"], counted["record_overflow"]) == (1, 1, 0)


def test_the_end_of_the_other_process_is_noticed() -> None:
    """When the server's process closes or ends, the node's is told that they have parted."""
    with rig() as both:
        both.there._pipe.close(1)
        assert both.parted.wait(10)


@pytest.mark.realtime
@pytest.mark.judges_times
def test_a_node_that_fails_elsewhere_ends_the_run_here() -> None:
    """What broke in the node's process is why the server's runtime failed."""
    with rig() as both:
        both.main.deliver("control", b"break", CLOCK.now())
        wait_until(lambda: both.here.runtime.failed is not None)
        both.here.close()
        wait_until(lambda: both.main.failed is not None)
        assert str(both.main.failed) == "actuator: broken on purpose"


def test_a_process_that_vanishes_ends_the_run_here() -> None:
    """A node's process that ends without a word ends the server's run, with a sentence."""
    with rig() as both:
        both.here._pipe.close(1)
        wait_until(lambda: both.main.failed is not None)
        assert str(both.main.failed) == "the process of the actuator has ended"


@pytest.mark.parametrize("where", ["sent", "read", "taken"])
def test_a_pipe_that_works_by_half_is_gone(where: str) -> None:
    """An entry that cannot be sent, read or taken ends the pipe at both ends: neither process goes on by itself."""
    ours, theirs = multiprocessing.Pipe()
    gone, told = threading.Event(), threading.Event()

    def take(_entry: object) -> None:
        raise LookupError("broken on purpose")

    one, other = Pipe(ours, lambda _: None, gone.set), Pipe(theirs, take, told.set)
    one.start()
    other.start()
    if where == "read":
        ours.send_bytes(b"no entry")
    else:
        one.send(threading.Lock() if where == "sent" else "an entry")
    assert told.wait(10)
    other.close(1)
    assert gone.wait(10)
    one.close(1)


def test_a_server_that_never_began_lets_the_process_end() -> None:
    """A server that fails before it hands anything over closes the pipe all the same: the node's process ends."""
    ours, theirs = multiprocessing.Pipe()
    parted = threading.Event()
    there = RemoteNodeProxy("actuator", ours)
    here = NodeHost(theirs, CLOCK, Echo(), note=lambda: 0, parted=parted.set)
    here.start()
    there.close(5)
    assert parted.wait(10)
    here.close()


@pytest.mark.realtime
def test_nobody_waits_for_a_process_that_does_not_read() -> None:
    """With nobody reading at the other end, all that does not fit is counted, and sending never waits."""
    ours, _theirs = multiprocessing.Pipe()
    pipe = Pipe(ours, lambda _entry: None, lambda: None)
    pipe.start()
    for _ in range(4 * CAPACITY):
        pipe.send(bytes(1000))
    assert CAPACITY < pipe.dropped <= 3 * CAPACITY


def test_a_pipe_that_was_never_started_closes() -> None:
    """A server that ends before its runtime began lets go of the other process, which notices."""
    ours, theirs = multiprocessing.Pipe()
    there = RemoteNodeProxy("actuator", ours)
    there.close(1)
    with pytest.raises(EOFError):
        theirs.recv_bytes()
    theirs.close()
