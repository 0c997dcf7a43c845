from __future__ import annotations

import statistics
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.node import WAKE, Message, Node, Send, Stage
from lavt.runtime.realtime import RealRuntime
from lavt.transport.clock_sync.clock_report import ClockReport

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("own_switch_interval")]


class ListRecorder:
    """A recorder and a link in one; it stores what is recorded and sent."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, Any]] = []
        self.sent: list[Send] = []

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (the protocol's)
        """Store one entry."""
        self.entries.append((topic, payload))

    def send(self, *sends: Send) -> None:
        """Store messages."""
        self.sent += sends


class PeriodicNode:
    """A node that wakes every 10 ms and stores its lateness; the message b"break" makes it fail."""

    name = "driver"

    def __init__(self, start_ns: int) -> None:
        self.counts: Counter[str] = Counter()
        self.late_ns: list[int] = []
        self.threads: set[str] = set()
        self._next_ns = start_ns
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            WAKE: (("wake", self._wake),),
            "state": (("receive", self._receive),),
        }

    def next_wake_ns(self) -> int:
        """Return when the next wake is due."""
        return self._next_ns

    def _wake(self, _message: Message, now: Now) -> list[Send]:
        self.late_ns.append(now.mono_ns - self._next_ns)
        self._next_ns = now.mono_ns + 10 * NS_PER_MS
        self.threads.add(threading.current_thread().name)
        return [Send("control", b"")]

    def _receive(self, message: Message, _now: Now) -> None:
        self.counts["received"] += 1
        if message.payload == b"break":
            raise ValueError("failed on purpose")


def start() -> tuple[RealRuntime, PeriodicNode, ListRecorder]:
    clock, recorded = MachineClock(), ListRecorder()
    node = PeriodicNode(clock.now().mono_ns)
    runtime = RealRuntime(clock, [node], recorded, lambda: ClockReport(0, 0, "host", "none"))
    runtime.start({"zenoh": recorded})
    return runtime, node, recorded


@pytest.mark.judges_times
def test_nodes_are_woken_in_time_and_messages_delivered() -> None:
    """A node wakes less than 20 ms late in the median, receives and sends messages, and `stop` ends its thread."""
    runtime, node, recorded = start()
    pause(NS_PER_S // 3)
    runtime.deliver("state", b"hello", runtime.now())
    pause(NS_PER_S // 10)
    runtime.stop()
    assert len(node.late_ns) > 5
    assert min(node.late_ns) >= 0
    assert statistics.median(node.late_ns) < 20 * NS_PER_MS
    assert node.counts["received"] == 1
    assert len(recorded.sent) == len(node.late_ns)
    assert node.threads == {"driver"}
    assert "driver" not in {thread.name for thread in threading.enumerate()}
    assert ("counts", {"node": "driver", "received": 1}) in recorded.entries


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a condition is true; whether that is in time is not judged."""
    clock = MachineClock()
    end_ns = clock.now().mono_ns + 20 * NS_PER_S
    while not condition():
        assert clock.now().mono_ns < end_ns, "the condition is not true within 20 s"
        pause(NS_PER_MS)


class ObservingNode:
    """A node that observes what the node "driver" receives, sends and records, and stores it."""

    name = "page_watch"

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.seen: list[tuple[str, Any]] = []
        self.pipelines: Mapping[str, Sequence[Stage]] = dict.fromkeys(
            ("state", "control", "lane"), (("note", self._note),)
        )

    def next_wake_ns(self) -> None:
        """Return None: only messages wake the node."""

    def _note(self, message: Message, _now: Now) -> None:
        self.seen.append((message.channel, message.payload))


class RecordingNode(PeriodicNode):
    """A node that answers each message with a command and an entry of the record."""

    def __init__(self) -> None:
        super().__init__(0)
        self.pipelines = {"state": (("answer", lambda _message, _now: [Send("control", b"go"), Send("lane", "seen")]),)}

    def next_wake_ns(self) -> None:  # type: ignore[override]
        """Return None: only messages wake the node."""


@pytest.mark.parametrize("is_observed", [True, False])
def test_an_observer_gets_what_others_receive_send_and_record(is_observed: bool) -> None:
    """An observer gets what a node receives, sends to the network and records, each once; the node is not affected."""
    clock, recorded, observer = MachineClock(), ListRecorder(), ObservingNode()
    nodes: list[Node] = [RecordingNode(), observer] if is_observed else [RecordingNode()]
    runtime = RealRuntime(clock, nodes, recorded, lambda: None)
    runtime.start({"zenoh": recorded})
    for number in range(3):
        runtime.deliver("state", number, runtime.now())
        wait_until(lambda answered=number + 1: len(recorded.sent) == answered)  # type: ignore[misc]
        wait_until(lambda seen=3 * (number + 1) * is_observed: len(observer.seen) >= seen)  # type: ignore[misc]
    pause(NS_PER_S // 20)  # for what must not come
    runtime.stop()
    assert runtime.failed is None
    seen = sorted(map(str, observer.seen))
    expected = [("control", b"go"), ("lane", "seen")] * 3 + [("state", number) for number in range(3)]
    assert seen == (sorted(map(str, expected)) if is_observed else [])
    assert recorded.sent == [Send("control", b"go")] * 3
    assert [entry for entry in recorded.entries if entry[0] == "lane"] == [("lane", "seen")] * 3


def test_a_failing_node_ends_the_run() -> None:
    """A node that fails ends the run with its error, and the runtime can still be stopped."""
    runtime, _, _ = start()
    runtime.deliver("state", b"break", runtime.now())
    assert runtime.stopped.wait(5)
    assert isinstance(runtime.failed, ValueError)
    runtime.stop()
    assert "driver" not in {thread.name for thread in threading.enumerate()}


class FailingWake(PeriodicNode):
    """A node whose `next_wake_ns` fails."""

    def next_wake_ns(self) -> int:
        """Raise an error."""
        raise ValueError("broken")


def test_a_node_that_fails_between_messages_ends_the_run() -> None:
    """A node whose `next_wake_ns` fails ends the run."""
    clock = MachineClock()
    runtime = RealRuntime(clock, [FailingWake(0)], ListRecorder(), lambda: None)
    runtime.start({})
    assert runtime.stopped.wait(5)
    assert isinstance(runtime.failed, ValueError)
    runtime.stop()
