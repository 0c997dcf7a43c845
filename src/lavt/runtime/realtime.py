"""The real-time runtime: links over the network, a thread and an inbox for each node, and the machine's clocks."""

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
from lavt.runtime.pipeline import run_stages
from lavt.runtime.recorder import Recorder
from lavt.runtime.wakeup import WakeEvent
from lavt.transport.clock_sync.clock_report import ClockReport

SWITCH_INTERVAL_S = 0.0005
"""With Python's default of 5 ms, one busy thread delays every other thread for that long."""

log = logging.getLogger(__name__)


class MessageLink(Protocol):
    """A carrier of messages to the other side."""

    def send(self, *sends: Send) -> None:
        """Send messages in order, without blocking and without raising network errors."""
        ...


class Receiver(Protocol):
    """A receiver of a node's messages."""

    def put(self, message: Message) -> None:
        """Accept a message without blocking."""
        ...


class RealRuntime:
    """A runtime that runs the nodes of one side on the machine's clocks.

    `links` has the link of each carrier to the network. `recorder` gets messages undecoded and must not block. A node
    that fails ends the run; `failed` is then its error. `remote_receivers` get the messages for nodes in other
    processes.
    """

    def __init__(
        self,
        clock: Clock,
        nodes: Sequence[Node],
        recorder: Recorder,
        clock_source: Callable[[], ClockReport | None],
        remote_receivers: Mapping[str, Receiver] = MappingProxyType({}),
    ) -> None:
        self.links: dict[str, MessageLink] = {}
        self.failed: BaseException | None = None
        self.stopped = threading.Event()
        self._clock = clock
        self._recorder = recorder
        self._clock_source = clock_source
        self._workers = {node.name: _Worker(self, node) for node in nodes}
        self._receivers: dict[str, Receiver] = {**remote_receivers, **self._workers}
        self._observers: dict[str, list[Receiver]] = {
            name: [self._workers[observer] for observer in channel.observers if observer in self._workers]
            for name, channel in CHANNELS.items()
        }

    def start(self, links: Mapping[str, MessageLink]) -> None:
        """Start to wake nodes and to deliver messages."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.collect()
        gc.freeze()  # later collections ignore the objects that exist by now, and so stall the nodes less
        self.links.update(links)
        for worker in self._workers.values():
            worker.thread.start()

    def stop(self) -> None:
        """Stop all threads and record the counts."""
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
        """Deliver a message to its receivers, and record it if it is not local; links call this from their threads."""
        if CHANNELS[channel].carrier != "local":
            self._recorder.write(channel, payload, arrived)
        self.put(Message(channel, payload, arrived, peer))

    def put(self, message: Message) -> None:
        """Deliver a message to its receivers and observers without recording it."""
        for receiver in CHANNELS[message.channel].receivers:
            self._receivers[receiver].put(message)
        self._show_observers(message)

    def record(self, topic: str, payload: Any, now: Now) -> None:
        """Record an entry that another process reports."""
        self._recorder.write(topic, payload, now)

    def carry(self, carrier: Carrier, sends: Sequence[Send]) -> None:
        """Send messages that another process has recorded already."""
        self.links[carrier].send(*sends)

    def fail(self, error: BaseException) -> None:
        """End the run because of an error; only the first error is kept."""
        self.failed = self.failed or error  # later errors are consequences of the first
        self.stopped.set()
        log.critical("%s: %s", type(error).__name__, error, exc_info=error)

    def run_pipeline(self, node: Node, message: Message) -> None:
        """Run a message through its pipeline and send the result."""
        readings = iter(self._clock.now, None)  # each `next` reads the clocks
        outcome = run_stages(node.name, node.pipelines[message.channel], message, next(readings), readings)
        for carrier, sends in groupby(outcome.sends, lambda send: CHANNELS[send.channel].carrier):
            self._send(carrier, tuple(sends))
        if outcome.timeline is not None:
            self._recorder.write("timeline", outcome.timeline, outcome.end)

    def now(self) -> Now:
        """Return a reading of the clocks."""
        return self._clock.now()

    def _send(self, carrier: Carrier, sends: Sequence[Send]) -> None:
        """Send messages of one carrier, then record them: so the packets of a frame leave without a gap."""
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
            if carrier != "local":
                self._show_observers(Message(send.channel, send.payload, now))

    def _show_observers(self, message: Message) -> None:
        for observer in self._observers[message.channel]:
            observer.put(message)

    def _report_clock(self) -> None:
        """Query the clock source; this has its own thread, because a query of chrony takes some milliseconds."""
        report = self._clock_source()
        if report is not None:
            self.deliver("clock_report", report, self._clock.now())


class _Worker:
    """The thread of a node, which runs its wakes and waiting messages and sleeps in between.

    Unless the node is busy, messages of inline channels run in the thread that delivers them, so that no other thread
    has to wake up. The thread that runs the node holds `_lock`.
    """

    def __init__(self, runtime: RealRuntime, node: Node) -> None:
        self.node = node
        self.inbox = Inbox()
        self.thread = threading.Thread(target=self._work, name=node.name, daemon=True)
        self._runtime = runtime
        self._lock = threading.Lock()
        self._inbox_lock = threading.Lock()
        self._wake_event = WakeEvent()
        self._wake_ns: int | None = 0
        """`next_wake_ns` of the node after its last run; written under `_lock`."""
        self._sleeps_until_ns: int | None = 0
        """When the thread wakes by itself; None: by `_wake_event` only; 0: it is awake."""

    def put(self, message: Message) -> None:
        if CHANNELS[message.channel].inline and self.inbox.is_empty() and self._lock.acquire(blocking=False):
            try:
                self._run(message)
            finally:
                self._lock.release()
            if self.inbox.is_empty() and not _is_before(self._wake_ns, self._sleeps_until_ns):
                return  # the node's thread need not wake earlier than it will
        else:
            with self._inbox_lock:
                self.inbox.put(message)
        self.notify()

    def notify(self) -> None:
        self._wake_event.set()

    def _work(self) -> None:
        try:
            while not self._runtime.stopped.is_set():
                with self._lock:
                    message = self._next_message()
                    if message is not None:
                        self._run(message)
                if message is None:
                    self._sleep()
        except BaseException as error:  # as in `_run`
            self._runtime.fail(error)

    def _run(self, message: Message) -> None:
        """Run a message through the node; the caller holds `_lock`."""
        if self._runtime.stopped.is_set():
            return
        try:
            self._runtime.run_pipeline(self.node, message)
            self._wake_ns = self.node.next_wake_ns()
        except BaseException as error:  # whatever the error of a node is, it must end the whole run
            self._runtime.fail(error)

    def _next_message(self) -> Message | None:
        """Return the next message to run; None: there is none.

        A due wake comes first, except for inline messages that arrived before the time of the wake.
        """
        self._wake_ns = wake_ns = self.node.next_wake_ns()
        if wake_ns is not None:
            now = self._runtime.now()
            if wake_ns <= now.mono_ns:
                with self._inbox_lock:
                    return self.inbox.take_arrived(wake_ns) or Message(WAKE, None, now)
        with self._inbox_lock:
            return self.inbox.take()

    def _sleep(self) -> None:
        """Sleep until the node's wake is due or a message arrives."""
        self._wake_event.clear()
        self._sleeps_until_ns = None  # from here on every message sets the event
        if self.inbox.is_empty() and not self._runtime.stopped.is_set():
            self._sleeps_until_ns = wake_ns = self._wake_ns
            pause_s = None if wake_ns is None else (wake_ns - self._runtime.now().mono_ns) / NS_PER_S
            self._wake_event.wait(pause_s)
        self._sleeps_until_ns = 0


def _is_before(one_ns: int | None, other_ns: int | None) -> bool:
    """Return whether a time is before another; None means never."""
    return one_ns is not None and (other_ns is None or one_ns < other_ns)
