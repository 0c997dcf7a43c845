from __future__ import annotations

import statistics
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.node import WAKE, Hop, Message, Send
from lavt.runtime.realtime import RealRuntime
from lavt.transport.clock_sync.clock_report import ClockReport

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("own_switch_interval")]


class Kept:
    """A recorder and a link that keep what they get."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, Any]] = []
        self.sent: list[Send] = []

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (the protocol's)
        """Write one entry."""
        self.entries.append((topic, payload))

    def send(self, *sends: Send) -> None:
        """Carry messages."""
        self.sent += sends


class Ticker:
    """A node that wakes every 10 ms and notes by how much it was late; a message of b"break" breaks it."""

    name = "driver"

    def __init__(self, start_ns: int) -> None:
        self.counts: Counter[str] = Counter()
        self.late_ns: list[int] = []
        self.threads: set[str] = set()
        self._next_ns = start_ns
        self.chains: Mapping[str, Sequence[Hop]] = {WAKE: (("tick", self._tick),), "state": (("hear", self._hear),)}

    def next_wake_ns(self) -> int:
        """When it wakes next."""
        return self._next_ns

    def _tick(self, _message: Message, now: Now) -> list[Send]:
        self.late_ns.append(now.mono_ns - self._next_ns)
        self._next_ns = now.mono_ns + 10 * NS_PER_MS
        self.threads.add(threading.current_thread().name)
        return [Send("control", b"")]

    def _hear(self, message: Message, _now: Now) -> None:
        self.counts["heard"] += 1
        if message.payload == b"break":
            raise ValueError("broken on purpose")


def start() -> tuple[RealRuntime, Ticker, Kept]:
    clock, kept = MachineClock(), Kept()
    node = Ticker(clock.now().mono_ns)
    runtime = RealRuntime(clock, [node], kept, lambda: ClockReport(0, 0, "host", "none"))
    runtime.start({"zenoh": kept})
    return runtime, node, kept


@pytest.mark.judges_times
def test_nodes_are_woken_in_time_and_messages_delivered() -> None:
    """A node wakes within 20 ms in the median, hears what is delivered, sends over its link; stop ends its thread."""
    runtime, node, kept = start()
    pause(NS_PER_S // 3)
    runtime.deliver("state", b"hello", runtime.now())
    pause(NS_PER_S // 10)
    runtime.stop()
    assert len(node.late_ns) > 5
    assert min(node.late_ns) >= 0
    assert statistics.median(node.late_ns) < 20 * NS_PER_MS
    assert node.counts["heard"] == 1
    assert len(kept.sent) == len(node.late_ns)
    assert node.threads == {"driver"}
    assert "driver" not in {thread.name for thread in threading.enumerate()}
    assert ("counts", {"node": "driver", "heard": 1}) in kept.entries


def test_a_failing_node_ends_the_run() -> None:
    """An error in a node stops the runtime, which says why, and it can still be stopped in order."""
    runtime, _, _ = start()
    runtime.deliver("state", b"break", runtime.now())
    assert runtime.stopped.wait(5)
    assert isinstance(runtime.failed, ValueError)
    runtime.stop()
    assert "driver" not in {thread.name for thread in threading.enumerate()}


class NeverSays(Ticker):
    """A node that breaks where it is asked when it wants to be woken."""

    def next_wake_ns(self) -> int:
        """Break."""
        raise ValueError("broken")


def test_a_node_that_breaks_between_messages_ends_the_run() -> None:
    """No half of a node stays alive, wherever it broke."""
    clock = MachineClock()
    runtime = RealRuntime(clock, [NeverSays(0)], Kept(), lambda: None)
    runtime.start({})
    assert runtime.stopped.wait(5)
    assert isinstance(runtime.failed, ValueError)
    runtime.stop()
