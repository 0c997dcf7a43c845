"""A node in its own process, connected by a pipe to the process with the other nodes of its side.

The node's process runs the node's pipelines and reports the results. The other process, the main process of the side,
has the links, the record and the other nodes. Both processes use the same clocks, because they run on one machine.
"""

from __future__ import annotations

import itertools
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Final

from lavt.channels import CHANNELS, Carrier
from lavt.clock import Clock
from lavt.domain import NS_PER_MS, Now
from lavt.errors import WorkError
from lavt.node import Message, Node, Peer, Send
from lavt.runtime.pipe import Pipe
from lavt.runtime.realtime import MessageLink, RealRuntime

LATE_NS: Final = 60 * NS_PER_MS
"""A message that took longer between the processes is late: one of the processes did not run meanwhile. Late commands,
states and replies are dropped."""
MAX_PENDING_PEERS: Final = 64
"""For a reply, the peer of a message is remembered until this many newer messages with a peer have arrived."""
CLOSE_TIMEOUT_S: Final = 1.0
CHECK_PERIOD_S: Final = 0.05
"""Period at which the node's heartbeat is checked. A silence is measured in checks, not in time: if the checking
process itself was frozen, only one check is missed."""
FIRST_HEARTBEAT_CHECKS: Final = 600
"""Number of checks after which the first heartbeat must have come: 30 s."""
SILENT_AFTER_CHECKS: Final = 2
"""Number of checks without a heartbeat after which the node is silent: 0.1 s."""
FAILED_AFTER_CHECKS: Final = 10
"""Number of checks without a heartbeat after which the node has failed: 0.5 s."""
END: Final = ("end",)

Report = tuple[Any, ...]
"""An entry from the node's process: ("deliver", channel, payload, arrived), ("send", carrier, sends, now), ("record",
topic, payload, now), ("status", the result of `get_status`), ("failed", reason)."""


class RemoteNodeProxy:
    """The proxy, in the main process, of a node in another process.

    It forwards messages to the node's process. It delivers, sends and records what that process reports. `heartbeat` is
    a topic that the node records all the time. After 0.1 s without an entry on this topic, `on_silent` is called; after
    0.5 s the run fails.
    """

    def __init__(
        self, name: str, connection: Connection, *, heartbeat: str, on_silent: Callable[[RealRuntime], None]
    ) -> None:
        self.name = name
        self._heartbeat, self._on_silent = heartbeat, on_silent
        self._missed = -FIRST_HEARTBEAT_CHECKS
        """Checks without a heartbeat; negative before the first one."""
        self._closing = threading.Event()
        self._checker = threading.Thread(target=self._check_heartbeats, name=f"{name}'s heartbeat", daemon=True)
        self.status: Any = None
        """The last status that the node's process reported."""
        self._pipe = Pipe(connection, self._receive, self._on_closed)
        self._runtime: RealRuntime | None = None
        self._peers: dict[int, Peer] = {}
        """The peers by number; the node's process gets the number. Different threads add and remove entries."""
        self._numbers = itertools.count(1)
        self._replies: SimpleQueue[tuple[Carrier, list[Send]] | None] = SimpleQueue()
        self._replier = threading.Thread(target=self._send_replies, name=f"{name}'s replies", daemon=True)
        self._replies_dropped = 0

    def start(self, runtime: RealRuntime) -> None:
        """Start to forward messages."""
        self._runtime = runtime
        self._pipe.start()
        self._replier.start()
        self._checker.start()

    def put(self, message: Message) -> None:
        """Forward a message to the node's process."""
        number = 0
        if message.peer is not None:
            number = next(self._numbers)
            self._peers[number] = message.peer
            self._peers.pop(number - MAX_PENDING_PEERS, None)
        self._pipe.send((message.channel, message.payload, message.arrived, number))

    def close(self, wait_s: float) -> None:
        """End the node's process, and process its remaining reports for at most `wait_s`."""
        self._closing.set()
        self._pipe.send(END)
        self._pipe.wait_closed(wait_s)
        self._pipe.close(CLOSE_TIMEOUT_S)
        if self._runtime is not None:
            self._replies.put(None)
            self._replier.join(CLOSE_TIMEOUT_S)
            counts = {  # of this end of the pipe; "node" names their origin in the record
                "node": f"to the {self.name}'s process",
                "messages_dropped": self._pipe.dropped,
                "replies_dropped": self._replies_dropped,
            }
            self._runtime.record("counts", counts, self._runtime.now())

    def _receive(self, report: Report) -> None:
        runtime = self._runtime
        if runtime is None:
            return
        kind, *rest = report
        if kind == "record":
            topic, payload, now = rest
            if topic == self._heartbeat:
                self._missed = 0
            runtime.record(topic, payload, now)
        elif kind == "send":
            carrier, sends, sent = rest
            if runtime.now().mono_ns - sent.mono_ns > LATE_NS:  # one process did not run; an old state is useless
                return
            self._carry(runtime, carrier, sends)
        elif kind == "deliver":
            runtime.deliver(*rest)
        elif kind == "status":
            (self.status,) = rest
        elif kind == "failed":
            (reason,) = rest
            runtime.fail(WorkError(reason))

    def _carry(self, runtime: RealRuntime, carrier: Carrier, sends: Sequence[Send]) -> None:
        """Send messages. Another thread sends the replies: if a router is frozen, Zenoh blocks replies for seconds."""
        without_peer = [send for send in sends if send.peer is None]
        replies = [Send(send.channel, send.payload, self._peers.pop(send.peer, None)) for send in sends if send.peer]
        if without_peer:
            runtime.carry(carrier, without_peer)
        if replies and self._replies.qsize() < MAX_PENDING_PEERS:
            self._replies.put((carrier, replies))
        elif replies:
            self._replies_dropped += 1

    def _send_replies(self) -> None:
        while self._runtime is not None and (entry := self._replies.get()) is not None:
            self._runtime.carry(*entry)

    def _check_heartbeats(self) -> None:
        while not self._closing.wait(CHECK_PERIOD_S):
            self.check_heartbeat()

    def check_heartbeat(self) -> None:
        """Count a check without a heartbeat; the next heartbeat resets the count."""
        runtime = self._runtime
        if runtime is None:
            return
        self._missed = missed = self._missed + 1  # the pipe's thread can reset `_missed` at any time
        if missed == SILENT_AFTER_CHECKS:
            self._on_silent(runtime)
        if missed in {0, FAILED_AFTER_CHECKS}:  # 0: the first heartbeat has not come in time
            runtime.fail(WorkError(f"the process of the {self.name} does not respond"))

    def _on_closed(self) -> None:
        if not self._closing.is_set() and self._runtime is not None:
            self._runtime.fail(WorkError(f"the process of the {self.name} has ended"))


class _MainProcess:
    """The main process as the node's runtime sees it: recorder, links and other nodes.

    Everything that is written, sent or put is passed to the main process through the pipe.
    """

    def __init__(self, pipe: Pipe, clock: Clock, report_status: Callable[[], None]) -> None:
        self._pipe, self._clock, self._report_status = pipe, clock, report_status

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Report one entry of the record."""
        self._pipe.send(("record", topic, payload, now))

    def send(self, *sends: Send) -> None:
        """Report messages to be sent by a link, after the node's status."""
        self._report_status()
        self._pipe.send(("send", CHANNELS[sends[0].channel].carrier, sends, self._clock.now()))

    def put(self, message: Message) -> None:
        """Report a message for another node."""
        self._pipe.send(("deliver", message.channel, message.payload, message.arrived))


class NodeHost:
    """The runtime of a single node in its own process.

    Before the node sends, the result of `get_status` is reported if it has changed. `on_disconnect` is called when the
    main process has ended or requests the end of this process.
    """

    def __init__(
        self,
        connection: Connection,
        clock: Clock,
        node: Node,
        *,
        get_status: Callable[[], Any],
        on_disconnect: Callable[[], None],
    ) -> None:
        self._clock = clock
        self._node = node
        self._get_status, self._status = get_status, None
        self._on_disconnect = on_disconnect
        self._late: Counter[str] = Counter()
        self._pipe = Pipe(connection, self._receive, on_disconnect)
        main_process = _MainProcess(self._pipe, clock, self._report_status)
        receivers = {receiver for channel in CHANNELS.values() for receiver in channel.receivers} - {node.name}
        self.runtime = RealRuntime(clock, [node], main_process, lambda: None, dict.fromkeys(receivers, main_process))
        self._links: dict[str, MessageLink] = {channel.carrier: main_process for channel in CHANNELS.values()}

    def start(self) -> None:
        """Start the runtime and the connection."""
        self.runtime.start(self._links)
        self._pipe.start()

    def deliver(self, channel: str, payload: Any) -> None:
        """Deliver a message that originates in this process to the node."""
        self.runtime.put(Message(channel, payload, self._clock.now()))

    def _report_status(self) -> None:
        """Report the node's status if it has changed."""
        status = self._get_status()
        if status != self._status:
            self._status = status
            self._pipe.send(("status", status))

    def close(self) -> None:
        """Stop the runtime, and report its counts and its error, if any."""
        self.runtime.stop()
        if self.runtime.failed is not None:
            self._pipe.send(("failed", f"{self._node.name}: {self.runtime.failed}"))
        # Whatever the pipe dropped is missing in the record, so it is an overflow of the record.
        counts = {"node": f"{self._node.name}'s process", "record_overflow": self._pipe.dropped, **self._late}
        self._pipe.send(("record", "counts", counts, self._clock.now()))
        self._pipe.close(CLOSE_TIMEOUT_S)

    def _receive(self, entry: tuple[Any, ...]) -> None:
        if entry == END:
            self._on_disconnect()
            return
        channel, payload, arrived, peer_number = entry
        now = self._clock.now()
        if now.mono_ns - arrived.mono_ns > LATE_NS:
            self._late[f"{channel}_late"] += 1
            if channel == "control":
                return
            arrived = now
        self.runtime.put(Message(channel, payload, arrived, peer_number or None))
