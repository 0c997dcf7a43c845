"""A node in a process of its own: both ends of what goes between its runtime and that of the other nodes of its side.

The node's own process walks its chains, and tells what came of them; links, record and the other nodes are the other
process'. The clocks are the same: it is one machine.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Final

from lavt.channels import CHANNELS
from lavt.clock import Clock
from lavt.domain import NS_PER_MS, Now
from lavt.errors import WorkError
from lavt.node import Message, Node, Peer, Send
from lavt.runtime.pipe import Pipe
from lavt.runtime.realtime import MessageLink, RealRuntime

LATE_NS: Final = 60 * NS_PER_MS
"""A command that took longer from process to process is not obeyed: one of the two did not run meanwhile."""
PEERS_KEPT: Final = 64
CLOSE_S: Final = 1.0
END: Final = ("end",)

Tell = tuple[Any, ...]
"""What the node's process tells: ("deliver", channel, payload, arrived), ("send", carrier, sends, when), ("record",
topic, payload, when), ("note", what `note` gave), ("failed", why)."""


class RemoteNodeProxy:
    """Stands for the node where the other nodes are: takes its messages, and does what its process tells."""

    def __init__(self, name: str, connection: Connection) -> None:
        self.name = name
        self.noted: Any = None
        """What the node's process noted last."""
        self._pipe = Pipe(connection, self._take, self._gone)
        self._runtime: RealRuntime | None = None
        self._peers: dict[int, Peer] = {}
        self._number = 0
        self._ends = False

    def start(self, runtime: RealRuntime) -> None:
        """Begin to hand over."""
        self._runtime = runtime
        self._pipe.start()

    def put(self, message: Message) -> None:
        """Hand a message over to the node's process."""
        number = 0
        if message.peer is not None:
            self._number = number = self._number + 1
            self._peers[number] = message.peer
            if len(self._peers) > PEERS_KEPT:
                self._peers.pop(next(iter(self._peers)))
        self._pipe.send((message.channel, message.payload, message.arrived, number))

    def close(self, wait_s: float) -> None:
        """Let the node's process end, and take what it still tells, for so long at most."""
        self._ends = True
        self._pipe.send(END)
        self._pipe.wait_gone(wait_s)
        self._pipe.close(CLOSE_S)
        if self._runtime is not None:
            lost = {"node": f"to the {self.name}'s process", "messages_dropped": self._pipe.dropped}
            self._runtime.record("counts", lost, self._runtime.now())

    def _take(self, told: Tell) -> None:
        runtime = self._runtime
        if runtime is None:
            return
        kind, *rest = told
        if kind == "record":
            runtime.record(*rest)
        elif kind == "send":
            carrier, sends, when = rest
            if runtime.now().mono_ns - when.mono_ns > LATE_NS:  # this process did not run: nobody wants an old state
                return
            runtime.carry(carrier, [self._with_peer(send) for send in sends])
        elif kind == "deliver":
            runtime.deliver(*rest)
        elif kind == "note":
            (self.noted,) = rest
        elif kind == "failed":
            runtime.fail(WorkError(rest[0]))

    def _with_peer(self, send: Send) -> Send:
        return send if send.peer is None else Send(send.channel, send.payload, self._peers.pop(send.peer, None))

    def _gone(self) -> None:
        if not self._ends and self._runtime is not None:
            self._runtime.fail(WorkError(f"the process of the {self.name} has ended"))


class _Outside:
    """Where the node is: recorder, link, and the other nodes, which are all at the other end of the pipe."""

    def __init__(self, pipe: Pipe, clock: Clock, look: Callable[[], None]) -> None:
        self._pipe, self._clock, self._look = pipe, clock, look

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Tell one entry of the record."""
        self._pipe.send(("record", topic, payload, now))

    def send(self, *sends: Send) -> None:
        """Tell what is to be sent by a link."""
        self._look()
        self._pipe.send(("send", CHANNELS[sends[0].channel].carrier, sends, self._clock.now()))

    def put(self, message: Message) -> None:
        """Tell what is for another node."""
        self._pipe.send(("deliver", message.channel, message.payload, message.arrived))


class NodeHost:
    """The node's process: a runtime of this node alone. `note` is asked before it sends, and told when it changed.

    `parted` is called when the other process has ended, or lets this one end.
    """

    def __init__(
        self, connection: Connection, clock: Clock, node: Node, *, note: Callable[[], Any], parted: Callable[[], None]
    ) -> None:
        self._clock = clock
        self._node = node
        self._note, self._noted = note, None
        self._parted = parted
        self._late: Counter[str] = Counter()
        self._pipe = Pipe(connection, self._take, parted)
        outside = _Outside(self._pipe, clock, self._look)
        receivers = {receiver for row in CHANNELS.values() for receiver in row.receivers} - {node.name}
        self.runtime = RealRuntime(clock, [node], outside, lambda: None, dict.fromkeys(receivers, outside))
        self._links: dict[str, MessageLink] = {row.carrier: outside for row in CHANNELS.values()}

    def start(self) -> None:
        """Begin."""
        self.runtime.start(self._links)
        self._pipe.start()

    def hand(self, channel: str, payload: Any) -> None:
        """Give the node a message of this process' own."""
        self.runtime.put(Message(channel, payload, self._clock.now()))

    def _look(self) -> None:
        """Tell what the node's `note` gives, where it is another."""
        noted = self._note()
        if noted != self._noted:
            self._noted = noted
            self._pipe.send(("note", noted))

    def close(self) -> None:
        """End the runtime, and tell what was counted, or why it failed."""
        self.runtime.stop()
        if self.runtime.failed is not None:
            self._pipe.send(("failed", f"{self._node.name}: {self.runtime.failed}"))
        lost = {"node": f"{self._node.name}'s process", "record_overflow": self._pipe.dropped, **self._late}
        self._pipe.send(("record", "counts", lost, self._clock.now()))
        self._pipe.close(CLOSE_S)

    def _take(self, told: tuple[Any, ...]) -> None:
        if told == END:
            self._parted()
            return
        channel, payload, arrived, peer = told
        now = self._clock.now()
        if now.mono_ns - arrived.mono_ns > LATE_NS:
            self._late[f"{channel}_late"] += 1
            if channel == "control":
                return
            arrived = now
        self.runtime.put(Message(channel, payload, arrived, peer or None))
