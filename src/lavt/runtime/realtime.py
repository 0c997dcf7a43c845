"""Real time: sockets, Zenoh, a thread and an inbox for each node, the machine's clocks."""

from __future__ import annotations

import gc
import logging
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from types import MappingProxyType
from typing import Any, Protocol

from lavt.channels import CHANNELS, Carrier
from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.node import WAKE, Message, Node, Peer, Send
from lavt.runtime.inbox import Inbox
from lavt.runtime.pipeline import walk
from lavt.runtime.recorder import Recorder
from lavt.runtime.wakeup import WakeEvent
from lavt.transport.clock_sync.clock_report import ClockReport

SWITCH_INTERVAL_S = 0.0005
"""Python's default of 5 ms lets one busy thread hold up every other for that long."""

log = logging.getLogger(__name__)


class MessageLink(Protocol):
    """What carries messages to the other side."""

    def send(self, *sends: Send) -> None:
        """Carry messages, in order; never waits, never raises for what the network does."""
        ...


class Receiver(Protocol):
    """Who takes messages for a node."""

    def put(self, message: Message) -> None:
        """Take a message; never waits."""
        ...


class RealRuntime:
    """Drives the nodes of one side by the machine's clocks.

    `links` carries what crosses the network, by carrier; `recorder` gets messages as they are, and must not wait. A
    node that fails ends the run: `failed` says why. `elsewhere` takes messages for nodes in other processes.
    """

    def __init__(
        self,
        clock: Clock,
        nodes: Sequence[Node],
        recorder: Recorder,
        clock_source: Callable[[], ClockReport | None],
        elsewhere: Mapping[str, Receiver] = MappingProxyType({}),
    ) -> None:
        self.links: dict[str, MessageLink] = {}
        self.failed: BaseException | None = None
        self.stopped = threading.Event()
        self._clock = clock
        self._recorder = recorder
        self._clock_source = clock_source
        self._workers = {node.name: _Worker(self, node) for node in nodes}
        self._receivers: dict[str, Receiver] = {**elsewhere, **self._workers}

    def start(self, links: Mapping[str, MessageLink]) -> None:
        """Begin: from here on nodes are woken and messages delivered."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.collect()
        gc.freeze()  # what exists by now stays: a full collection over it would be a hitch
        self.links.update(links)
        for worker in self._workers.values():
            worker.thread.start()

    def stop(self) -> None:
        """End all threads and write the counters down."""
        self.stopped.set()
        for worker in self._workers.values():
            worker.notify()
        for worker in self._workers.values():
            if worker.thread.is_alive():
                worker.thread.join()
        now = self._clock.now()
        for worker in self._workers.values():
            counts = {**worker.node.counts, **worker.inbox.counts}
            self._recorder.write("counts", {"node": worker.node.name, **counts}, now)

    def deliver(self, channel: str, payload: Any, arrived: Now, peer: Peer = None) -> None:
        """Let a message wait for its receivers; links call this, from threads of their own."""
        if CHANNELS[channel].carrier != "local":
            self._recorder.write(channel, payload, arrived)
        self.put(Message(channel, payload, arrived, peer))

    def put(self, message: Message) -> None:
        """Let a message wait for its receivers, and write nothing down."""
        for receiver in CHANNELS[message.channel].receivers:
            self._receivers[receiver].put(message)

    def record(self, topic: str, payload: Any, now: Now) -> None:
        """Write down what happened in another process."""
        self._recorder.write(topic, payload, now)

    def carry(self, carrier: Carrier, sends: Sequence[Send]) -> None:
        """Send what another process has written down."""
        self.links[carrier].send(*sends)

    def fail(self, error: BaseException) -> None:
        """A thread ended with an error: so does the run."""
        log.critical("%s: %s", type(error).__name__, error, exc_info=error)
        self.failed = self.failed or error  # what comes after is of the first
        self.stopped.set()

    def run_pipeline(self, node: Node, message: Message) -> None:
        """Walk a message through its hops and send what comes out."""
        readings = iter(self._clock.now, None)
        outcome = walk(node.name, node.chains[message.channel], message, next(readings), readings)
        for carrier, sends in groupby(outcome.sends, lambda send: CHANNELS[send.channel].carrier):
            self._send(carrier, tuple(sends))
        if outcome.timeline is not None:
            self._recorder.write("timeline", outcome.timeline, outcome.end)

    def now(self) -> Now:
        """Read the clocks."""
        return self._clock.now()

    def _send(self, carrier: Carrier, sends: Sequence[Send]) -> None:
        """Send what goes the same way: the packets of a frame leave one right after the other."""
        now = self._clock.now()
        if carrier == "local":
            for send in sends:
                self.deliver(send.channel, send.payload, now)
        elif carrier == "clock":
            threading.Thread(target=self._report_clock, name="clock source", daemon=True).start()
        elif carrier != "record":
            self.links[carrier].send(*sends)
        for send in sends:
            self._recorder.write(send.channel, send.payload, now)

    def _report_clock(self) -> None:
        """Asking chrony takes a process of its own and some milliseconds: no node waits for it."""
        report = self._clock_source()
        if report is not None:
            self.deliver("clock_report", report, self._clock.now())


class _Worker:
    """A node's thread: wakes it when it asked, hands it what waits, sleeps in between.

    What is to be walked at once is walked by whoever brings it, unless the node is busy: no thread has to wake up for
    it. Who walks has the turn.
    """

    def __init__(self, runtime: RealRuntime, node: Node) -> None:
        self.node = node
        self.inbox = Inbox()
        self.thread = threading.Thread(target=self._work, name=node.name, daemon=True)
        self._runtime = runtime
        self._turn = threading.Lock()
        self._inbox_turn = threading.Lock()
        self._bell = WakeEvent()
        self._wake_ns: int | None = 0
        """When the node wants to be woken, as it said when it was walked last; written by who has the turn."""
        self._sleeps_until_ns: int | None = 0
        """When the thread wakes by itself; None: only when the bell rings; 0: it is awake."""

    def put(self, message: Message) -> None:
        if CHANNELS[message.channel].at_once and self.inbox.is_empty() and self._turn.acquire(blocking=False):
            try:
                self._walk(message)
            finally:
                self._turn.release()
            if self.inbox.is_empty() and not _is_before(self._wake_ns, self._sleeps_until_ns):
                return
        else:
            with self._inbox_turn:
                self.inbox.put(message)
        self.notify()

    def notify(self) -> None:
        self._bell.ring()

    def _work(self) -> None:
        try:
            while not self._runtime.stopped.is_set():
                with self._turn:
                    outcome = self._walk_next()
                if not outcome:
                    self._sleep()
        except BaseException as error:  # as in `_walk`
            self._runtime.fail(error)

    def _walk_next(self) -> bool:
        """Walk what comes next through the node; False where nothing does. Needs the turn."""
        message = self._next()
        if message is not None:
            self._walk(message)
        return message is not None

    def _walk(self, message: Message) -> None:
        """Walk a message through the node. Needs the turn."""
        if self._runtime.stopped.is_set():
            return
        try:
            self._runtime.run_pipeline(self.node, message)
            self._wake_ns = self.node.next_wake_ns()
        except BaseException as error:  # whatever ends a node must end the run, not leave half of it alive
            self._runtime.fail(error)

    def _next(self) -> Message | None:
        """What the node does next: a wake that is due, but before it what had arrived by then; else what waits."""
        self._wake_ns = wake_ns = self.node.next_wake_ns()
        if wake_ns is not None:
            now = self._runtime.now()
            if wake_ns <= now.mono_ns:
                with self._inbox_turn:
                    return self.inbox.take_arrived(wake_ns) or Message(WAKE, None, now)
        with self._inbox_turn:
            return self.inbox.take()

    def _sleep(self) -> None:
        """Sleep until the node wants to be woken, or somebody says that there is something to do."""
        self._bell.silence()
        self._sleeps_until_ns = None  # from here on the bell is rung for whatever comes
        if self.inbox.is_empty() and not self._runtime.stopped.is_set():
            self._sleeps_until_ns = wake_ns = self._wake_ns
            pause_s = None if wake_ns is None else (wake_ns - self._runtime.now().mono_ns) / NS_PER_S
            self._bell.wait(pause_s)
        self._sleeps_until_ns = 0


def _is_before(one_ns: int | None, other_ns: int | None) -> bool:
    """Compare two times, of which None is never."""
    return one_ns is not None and (other_ns is None or one_ns < other_ns)
