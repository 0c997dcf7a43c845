"""Virtual time: one heap of events, simulated links, hosts with clocks of their own, as fast as the machine goes.

Real pixels, the real codec and real packets pass through the nodes; only waiting is skipped. The same seed and the same
configuration give the same result, bit for bit.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, repeat
from typing import Any

from lavt.channels import CHANNELS
from lavt.domain import NS_PER_S, Now
from lavt.node import WAKE, Message, Node, Peer, Send
from lavt.runtime.inbox import Inbox
from lavt.runtime.pipeline import walk
from lavt.runtime.recorder import UNRECORDED, WIRE, Recorder, record
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.emulation.delay_line import DelayLine

NS_PER_PPB = 1_000_000_000


@dataclass
class HostClock:
    """Both clocks of a virtual host, as exact functions of the true time.

    `offset_ns` is the wall clock's at true time 0, `drift_ppb` how much too fast the host's oscillator is (parts in
    10^9, in both clocks), and `steps` are sudden changes of the wall clock: (true time, change), in order.
    """

    mono_start_ns: int
    wall_start_ns: int
    offset_ns: int = 0
    drift_ppb: int = 0
    steps: Sequence[tuple[int, int]] = ()

    def at(self, true_ns: int) -> Now:
        """Read both clocks at a true time."""
        drift_ppb = self.drift_ppb
        gone_ns = true_ns + true_ns * drift_ppb // NS_PER_PPB if drift_ppb else true_ns
        wall_ns = self.wall_start_ns + self.offset_ns + gone_ns
        if self.steps:
            wall_ns += sum(change_ns for at_ns, change_ns in self.steps if at_ns <= true_ns)
        return Now(self.mono_start_ns + gone_ns, wall_ns)

    def true_ns(self, mono_ns: int) -> int:
        """Tell the first true time at which the monotonic clock shows at least `mono_ns`."""
        gone_ns = mono_ns - self.mono_start_ns
        if not self.drift_ppb:
            return gone_ns
        guess_ns = gone_ns * NS_PER_PPB // (NS_PER_PPB + self.drift_ppb)
        while guess_ns + guess_ns * self.drift_ppb // NS_PER_PPB < gone_ns:
            guess_ns += 1
        return guess_ns


@dataclass
class VirtualLink:
    """A simulated link of one channel: a delay line, and how its packets are numbered for the delay law."""

    line: DelayLine
    index: Callable[[bytes, int], int]
    """(payload, number of the packet) to the index of its delay; packets of one frame share theirs."""
    count: int = 0
    open: bool = True
    """A closed link loses what is sent."""


@dataclass
class VirtualHost:
    """One side: its clock, nodes, record, the cost of each hop, and its source of clock reports."""

    side: str
    clock: HostClock
    nodes: Sequence[Node]
    recorder: Recorder
    costs_ns: Mapping[tuple[str, str], int]
    """(node, hop) to its cost, (node, "wait_CHANNEL") to that of waking the node; what is not named costs nothing."""
    clock_source: Callable[[int], ClockReport]
    peer: Peer = None
    """How this host looks from the other side."""
    left_out: frozenset[str] = frozenset()
    """Channels that are not recorded."""
    running: dict[str, _Running] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.unrecorded = UNRECORDED | self.left_out
        self.running = {node.name: _Running(self, node) for node in self.nodes}
        self.receivers = {
            channel: tuple(self.running[name] for name in row.receivers)
            for channel, row in CHANNELS.items()
            if self.running.keys() >= set(row.receivers)
        }
        """For each channel the nodes of this host that listen to it."""
        self._read_ns = -1
        self._read = Now(0, 0)

    def now(self, true_ns: int) -> Now:
        """Read both clocks; several things happen at one time, so the last reading is kept."""
        if true_ns != self._read_ns:
            self._read_ns, self._read = true_ns, self.clock.at(true_ns)
        return self._read


class _Running:
    """A node at work: what waits for it, until when it is busy, and when it is looked at next."""

    def __init__(self, host: VirtualHost, node: Node) -> None:
        self.host = host
        self.node = node
        self.inbox = Inbox()
        self.chains = {
            channel: (stages, _spent_ns(host.costs_ns, node.name, (f"wait_{channel}", *(name for name, _ in stages))))
            for channel, stages in node.chains.items()
        }
        """Each chain, and how long after its begin the first hop begins and each hop is done."""
        self.next_wake_ns = node.next_wake_ns
        self.free_ns = 0
        self.poke_ns: int | None = None
        self.poked_ns: set[int] = set()
        """When it is looked at next, and for when that has been asked: often again for a time that still stands."""
        self.wake_mono_ns: int | None = None
        self.wake_ns: int | None = None
        """When the node wants to be woken, on its host's monotonic clock and in true time."""
        self.note_wake(node.next_wake_ns())

    def note_wake(self, wake_mono_ns: int | None) -> None:
        """Note when the node wants to be woken."""
        self.wake_mono_ns = wake_mono_ns
        self.wake_ns = None if wake_mono_ns is None else self.host.clock.true_ns(wake_mono_ns)


def _spent_ns(costs_ns: Mapping[tuple[str, str], int], node: str, steps: Sequence[str]) -> tuple[int, ...]:
    """Tell after how long each step of a node is done, one after the other."""
    return tuple(accumulate(costs_ns.get((node, step), 0) for step in steps))


class VirtualRuntime:
    """Drives the nodes of two hosts and the links between them through virtual time."""

    def __init__(self, hosts: Sequence[VirtualHost], links: Mapping[str, VirtualLink]) -> None:
        self.true_ns = 0
        self.hosts = {host.side: host for host in hosts}
        self.links = dict(links)
        self._other = {side: next(other for other in self.hosts if other != side) for side in self.hosts}
        self._heap: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = []
        self._number = 0
        for host in hosts:
            for running in host.running.values():
                self._poke(running, 0)

    def at(self, true_ns: int, action: Callable[..., None], *arguments: Any) -> None:
        """Call `action` with `arguments` at a true time."""
        self._number += 1
        heapq.heappush(self._heap, (true_ns, self._number, action, arguments))

    def run(self, limit_ns: int, finished: Callable[[], bool]) -> bool:
        """Run until `finished()` or to the limit; tell whether it finished."""
        heap, take = self._heap, heapq.heappop
        while heap and heap[0][0] <= limit_ns:
            self.true_ns, _, action, arguments = take(heap)
            action(*arguments)
            if finished():
                return True
        return False

    def close(self) -> None:
        """Write the counters of nodes, inboxes and links that do more than delay into the records."""
        for host in self.hosts.values():
            now = host.clock.at(self.true_ns)
            for name, running in host.running.items():
                counts: dict[str, Any] = {**running.node.counts, **running.inbox.counts}
                host.recorder.write("counts", {"node": name, **counts}, now)
            for channel, link in self.links.items():
                if link.line.link is not None and CHANNELS[channel].sender in host.running:
                    did = {f"link_{name}": number for name, number in link.line.link.counts.items()}
                    host.recorder.write("counts", {"node": f"link {channel}", **did}, now)

    def deliver(self, side: str, channel: str, payload: Any, peer: Peer = None) -> None:
        """Let a message arrive on a side, now; what came over the network is written down."""
        host = self.hosts[side]
        arrived = host.now(self.true_ns)
        if CHANNELS[channel].carrier != "local" and channel not in host.unrecorded:
            record(host.recorder, channel, payload, arrived)
        self._put(host, Message(channel, payload, arrived, peer))

    def _put(self, host: VirtualHost, message: Message) -> None:
        true_ns = self.true_ns
        for running in host.receivers[message.channel]:
            running.inbox.put(message)
            free_ns = running.free_ns
            self._poke(running, max(true_ns, free_ns))

    def _poke(self, running: _Running, true_ns: int) -> None:
        """Look at a node at `true_ns`, unless it is looked at before anyway."""
        if running.poke_ns is None or true_ns < running.poke_ns:
            running.poke_ns = true_ns
            if true_ns not in running.poked_ns:
                running.poked_ns.add(true_ns)
                self._number += 1
                heapq.heappush(self._heap, (true_ns, self._number, self._look, (running, true_ns)))

    def _look(self, running: _Running, true_ns: int) -> None:
        running.poked_ns.remove(true_ns)
        if running.poke_ns != true_ns:
            return  # it was looked at earlier, and has asked anew
        running.poke_ns = None
        wake_ns = running.wake_ns
        if wake_ns is not None and wake_ns <= true_ns:
            now = running.host.now(true_ns)
            self._walk(running, Message(WAKE, None, now), now)
        elif (message := running.inbox.take()) is not None:
            self._walk(running, message, running.host.now(true_ns))
        elif wake_ns is not None:
            self._poke(running, wake_ns)

    def _walk(self, running: _Running, message: Message, now: Now) -> None:
        host, true_ns = running.host, self.true_ns
        stages, spent_ns = running.chains[message.channel]
        times: Iterator[Now] = repeat(now)
        if spent_ns[-1]:
            times = map(host.clock.at, map(true_ns.__add__, spent_ns))
        outcome = walk(running.node.name, stages, message, next(times), times)
        took_ns = spent_ns[outcome.called]
        running.free_ns = free_ns = true_ns + took_ns
        if outcome.timeline is not None:
            host.recorder.write("timeline", outcome.timeline, outcome.end)
        if outcome.sends:
            if took_ns:
                self.at(free_ns, self._send_all, host, outcome.sends, outcome.end)
            else:
                self._send_all(host, outcome.sends, outcome.end)
        # When the node wants to be woken, nothing but a walk through its hops changes.
        wake_mono_ns = running.next_wake_ns()
        if wake_mono_ns != running.wake_mono_ns:
            running.note_wake(wake_mono_ns)
        if running.inbox.waiting:
            self._poke(running, free_ns)
        elif (wake_ns := running.wake_ns) is not None:
            self._poke(running, max(wake_ns, free_ns))

    def _send_all(self, host: VirtualHost, sends: Sequence[Send], now: Now) -> None:
        write, unrecorded = host.recorder.write, host.unrecorded
        for send in sends:
            channel = send.channel
            if channel not in unrecorded:  # as in `record`, without a call for each message
                write(channel, WIRE[channel](send.payload) if channel in WIRE else send.payload, now)
            carrier = CHANNELS[channel].carrier
            if carrier == "record":
                continue
            if carrier == "local":
                self._put(host, Message(channel, send.payload, now))
            elif carrier == "clock":
                self.deliver(host.side, "clock_report", host.clock_source(self.true_ns))
            else:
                self._carry(host, send)

    def _carry(self, host: VirtualHost, send: Send) -> None:
        link = self.links[send.channel]
        link.count += 1
        if not link.open:
            return
        payload: bytes = send.payload
        due_ns = link.line.push((payload, host.peer), self.true_ns, link.index(payload, link.count), len(payload))
        if due_ns is not None:
            self.at(due_ns, self._arrive, link, send.channel, self._other[host.side])

    def _arrive(self, link: VirtualLink, channel: str, side: str) -> None:
        for payload, peer in link.line.pop_due(self.true_ns):
            self.deliver(side, channel, payload, peer)


def modelled_clock_source(clock: HostClock, host: str, error_s: float, bound_s: float) -> Callable[[int], ClockReport]:
    """Model chrony on a virtual host: it reports the truth plus `error_s`, which lies inside its stated `bound_s`."""

    def report(true_ns: int) -> ClockReport:
        now = clock.at(true_ns)
        ahead_ns = now.wall_ns - (clock.wall_start_ns + true_ns)
        return ClockReport(now.mono_ns, now.wall_ns, host, "model", -ahead_ns / NS_PER_S + error_s, bound_s)

    return report
