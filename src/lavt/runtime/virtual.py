"""The virtual-time runtime: one event heap, simulated links, and hosts with their own clocks.

Pixels, codec and packets are as in real time; only waiting is skipped. A stage takes a constant time, or a time that is
drawn from a measured distribution. The same seed and configuration give a byte-for-byte reproducible result.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, repeat
from typing import Any

from lavt.channels import CHANNELS
from lavt.domain import NS_PER_S, Now
from lavt.node import WAKE, Message, Node, Peer, Send, Stage
from lavt.runtime.inbox import Inbox
from lavt.runtime.pipeline import run_stages
from lavt.runtime.recorder import UNRECORDED, WIRE_DECODERS, Recorder, record
from lavt.streams import QuantileStream
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.emulation.delay_line import DelayLine

ONE_IN_PPB = 1_000_000_000

FRAMES_PER_S = 120
"""Draws for frames are numbered by time in steps of 1/120 s: frames at up to this rate have different draws."""
RTP_TICKS_PER_DRAW = 90_000 // FRAMES_PER_S
"""The same step in the units of RTP timestamps."""

Cost = int | QuantileStream
"""The processing time of a stage in ns: constant, or drawn from a distribution."""


@dataclass
class HostClock:
    """The two clocks of a virtual host, as exact functions of the true time.

    `offset_ns` is the offset of the wall clock at true time 0, and `drift_ppb` the drift of both clocks in parts per
    10^9 (positive: too fast). `steps` are the steps of the wall clock as (true time, change), in order of time.
    """

    mono_start_ns: int
    wall_start_ns: int
    offset_ns: int = 0
    drift_ppb: int = 0
    steps: Sequence[tuple[int, int]] = ()

    def now_at(self, true_ns: int) -> Now:
        """Return the reading of both clocks at a true time."""
        drift_ppb = self.drift_ppb
        elapsed_ns = true_ns + true_ns * drift_ppb // ONE_IN_PPB if drift_ppb else true_ns
        wall_ns = self.wall_start_ns + self.offset_ns + elapsed_ns
        if self.steps:
            wall_ns += sum(change_ns for at_ns, change_ns in self.steps if at_ns <= true_ns)
        return Now(self.mono_start_ns + elapsed_ns, wall_ns)

    def true_ns(self, mono_ns: int) -> int:
        """Return the first true time at which the monotonic clock shows at least `mono_ns`."""
        elapsed_ns = mono_ns - self.mono_start_ns
        if not self.drift_ppb:
            return elapsed_ns
        candidate_ns = elapsed_ns * ONE_IN_PPB // (ONE_IN_PPB + self.drift_ppb)
        while candidate_ns + candidate_ns * self.drift_ppb // ONE_IN_PPB < elapsed_ns:
            candidate_ns += 1
        return candidate_ns


@dataclass
class VirtualLink:
    """A simulated link of one channel: a delay line, and a function that selects the delay of each packet."""

    line: DelayLine
    index: Callable[[bytes, int], int]
    """Maps (payload, packet number) to the index of the packet's delay; packets of one frame share an index."""
    count: int = 0
    """Number of packets that were sent."""
    open: bool = True
    """A closed link loses all packets."""


@dataclass
class VirtualHost:
    """A host of one side: its clock, nodes, recorder, processing times and clock source."""

    side: str
    clock: HostClock
    nodes: Sequence[Node]
    recorder: Recorder
    costs_ns: Mapping[tuple[str, str], Cost]
    """Processing time by (node, stage). The time from a message on CHANNEL to the first stage has the key
    (node, "wait_CHANNEL"). Times that are not listed are 0."""
    clock_source: Callable[[int], ClockReport]
    peer: Peer = None
    """The peer that the other side sees as the sender of this host's messages."""
    left_out: frozenset[str] = frozenset()
    """Channels that are not recorded, besides those in `UNRECORDED`."""
    runners: dict[str, _NodeRunner] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.unrecorded = UNRECORDED | self.left_out
        self.runners = {node.name: _NodeRunner(self, node) for node in self.nodes}
        self.receivers = {
            name: tuple(self.runners[receiver] for receiver in channel.receivers)
            for name, channel in CHANNELS.items()
            if self.runners.keys() >= set(channel.receivers)
        }
        """The receiving nodes of this host by channel."""
        self._cached_ns = -1
        self._cached_now = Now(0, 0)

    def now(self, true_ns: int) -> Now:
        """Return a reading of both clocks; the last reading is cached, because many events share a time."""
        if true_ns != self._cached_ns:
            self._cached_ns, self._cached_now = true_ns, self.clock.now_at(true_ns)
        return self._cached_now


class _NodeRunner:
    """A node in virtual time, with its inbox and its scheduled steps; in each step it runs one pipeline or none."""

    def __init__(self, host: VirtualHost, node: Node) -> None:
        self.host = host
        self.node = node
        self.inbox = Inbox()
        self.pipelines = {
            channel: _Pipeline(
                stages,
                [
                    host.costs_ns.get((node.name, name), 0)
                    for name in (f"wait_{channel}", *(name for name, _ in stages))
                ],
            )
            for channel, stages in node.pipelines.items()
        }
        self.free_ns = 0
        """When the last pipeline run ends."""
        self.next_step_ns: int | None = None
        self.scheduled_ns: set[int] = set()
        """Times of all steps in the event heap, so that no time is scheduled twice."""
        self.wake_mono_ns: int | None = None
        """The node's next wake on its host's monotonic clock."""
        self.wake_ns: int | None = None
        """The same wake in true time."""
        self.set_wake(node.next_wake_ns())

    def set_wake(self, wake_mono_ns: int | None) -> None:
        """Store the node's next wake."""
        self.wake_mono_ns = wake_mono_ns
        self.wake_ns = None if wake_mono_ns is None else self.host.clock.true_ns(wake_mono_ns)


class _Pipeline:
    """The stages of a pipeline, and the costs of its wait and of each stage."""

    def __init__(self, stages: Sequence[Stage], costs_ns: Sequence[Cost]) -> None:
        self.stages = stages
        self.runs = 0
        self._costs_ns = costs_ns
        constant_ns = [cost for cost in costs_ns if isinstance(cost, int)]
        self._ends_ns = tuple(accumulate(constant_ns)) if len(constant_ns) == len(costs_ns) else None

    def end_times_ns(self, message: Message, wake_ns: int | None) -> tuple[int, ...]:
        """Return when the first stage begins and each stage ends, counted from the beginning of the pipeline run.

        `wake_ns` is when the node asked to be woken, on its host's monotonic clock.
        """
        self.runs += 1
        if self._ends_ns is not None:
            return self._ends_ns
        number = _draw_number(message, wake_ns, self.runs)
        return tuple(accumulate(cost if isinstance(cost, int) else cost.at(number) for cost in self._costs_ns))


def _draw_number(message: Message, wake_ns: int | None, run_number: int) -> int:
    """Return the number of the draws for a pipeline run: the same for the same frame under every network condition.

    The number comes from the frame's stamp or RTP timestamp, or from the time for which a wake was requested. A message
    without either, such as a command, has the number of the pipeline run.
    """
    payload = message.payload
    if message.channel == WAKE and wake_ns is not None:
        return wake_ns * FRAMES_PER_S // NS_PER_S
    if isinstance(stamp_ns := getattr(payload, "stamp_ns", None), int):
        return stamp_ns * FRAMES_PER_S // NS_PER_S
    if isinstance(timestamp := getattr(payload, "rtp_timestamp", None), int):
        return timestamp // RTP_TICKS_PER_DRAW
    return run_number


class VirtualRuntime:
    """A runtime that runs the nodes of two hosts and the links between them in virtual time."""

    def __init__(self, hosts: Sequence[VirtualHost], links: Mapping[str, VirtualLink]) -> None:
        self.true_ns = 0
        self.hosts = {host.side: host for host in hosts}
        self.links = dict(links)
        self._other = {side: next(other for other in self.hosts if other != side) for side in self.hosts}
        self._heap: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = []
        """The events: true time, number, action and its arguments. The number keeps the order of events at one time."""
        self._number = 0
        for host in hosts:
            for runner in host.runners.values():
                self._schedule(runner, 0)

    def call_at(self, true_ns: int, action: Callable[..., None], *arguments: Any) -> None:
        """Call `action` with `arguments` at a true time."""
        self._number += 1
        heapq.heappush(self._heap, (true_ns, self._number, action, arguments))

    def run(self, limit_ns: int, finished: Callable[[], bool]) -> bool:
        """Run until `finished()` is true or the true time is `limit_ns`; return whether `finished()` is true."""
        heap, pop = self._heap, heapq.heappop
        while heap and heap[0][0] <= limit_ns:
            self.true_ns, _, action, arguments = pop(heap)
            action(*arguments)
            if finished():
                return True
        return False

    def close(self) -> None:
        """Record the counts of nodes, of inboxes, and of links that do more than delay."""
        for host in self.hosts.values():
            now = host.clock.now_at(self.true_ns)
            for name, runner in host.runners.items():
                counts: dict[str, Any] = {**runner.node.counts, **runner.inbox.counts}
                host.recorder.write("counts", {"node": name, **counts}, now)
            for channel, link in self.links.items():
                emulated = link.line.link
                if emulated is not None and CHANNELS[channel].sender in host.runners:
                    counts = {f"link_{name}": number for name, number in emulated.counts.items()}
                    host.recorder.write("counts", {"node": f"link {channel}", **counts}, now)

    def deliver(self, side: str, channel: str, payload: Any, peer: Peer = None) -> None:
        """Deliver a message to a side at the present true time; record it unless its channel is local."""
        host = self.hosts[side]
        arrived = host.now(self.true_ns)
        if CHANNELS[channel].carrier != "local" and channel not in host.unrecorded:
            record(host.recorder, channel, payload, arrived)
        self._put(host, Message(channel, payload, arrived, peer))

    def deliver_first(self, side: str, channel: str, payload: Any) -> None:
        """Deliver a message before all that wait at its receivers, which must not be in the middle of a pipeline."""
        host = self.hosts[side]
        now = host.now(self.true_ns)
        for runner in host.receivers[channel]:
            if runner.free_ns > self.true_ns:
                raise RuntimeError(f"{runner.node.name} cannot receive {channel}: it is in the middle of a pipeline")
            runner.next_step_ns = None  # the waiting messages, and a wake that is due, come after this message
            self._run_pipeline(runner, Message(channel, payload, now), now)

    def _put(self, host: VirtualHost, message: Message) -> None:
        true_ns = self.true_ns
        for runner in host.receivers[message.channel]:
            runner.inbox.put(message)
            free_ns = runner.free_ns
            self._schedule(runner, max(true_ns, free_ns))

    def _schedule(self, runner: _NodeRunner, true_ns: int) -> None:
        """Schedule a step of a node at `true_ns`, unless an earlier one is scheduled."""
        if runner.next_step_ns is None or true_ns < runner.next_step_ns:
            runner.next_step_ns = true_ns
            if true_ns not in runner.scheduled_ns:
                runner.scheduled_ns.add(true_ns)
                self._number += 1
                heapq.heappush(self._heap, (true_ns, self._number, self._step, (runner, true_ns)))

    def _step(self, runner: _NodeRunner, true_ns: int) -> None:
        runner.scheduled_ns.remove(true_ns)
        if runner.next_step_ns != true_ns:
            return  # after this step was scheduled, one at an earlier time replaced it and has already run
        runner.next_step_ns = None
        wake_ns = runner.wake_ns
        if wake_ns is not None and wake_ns <= true_ns:
            now = runner.host.now(true_ns)
            self._run_pipeline(runner, Message(WAKE, None, now), now)
        elif (message := runner.inbox.take()) is not None:
            self._run_pipeline(runner, message, runner.host.now(true_ns))
        elif wake_ns is not None:
            self._schedule(runner, wake_ns)

    def _run_pipeline(self, runner: _NodeRunner, message: Message, now: Now) -> None:
        host, true_ns = runner.host, self.true_ns
        pipeline = runner.pipelines[message.channel]
        ends_ns = pipeline.end_times_ns(message, runner.wake_mono_ns)
        # `times` yields the start of the first stage, then the end of each stage.
        times: Iterator[Now] = repeat(now)  # if no stage takes time, they are all the same
        if ends_ns[-1]:
            times = map(host.clock.now_at, [true_ns + end_ns for end_ns in ends_ns])
        outcome = run_stages(runner.node.name, pipeline.stages, message, next(times), times)
        duration_ns = ends_ns[outcome.stages_run]
        runner.free_ns = free_ns = true_ns + duration_ns
        if outcome.timeline is not None:
            host.recorder.write("timeline", outcome.timeline, outcome.end)
        if outcome.sends:
            if duration_ns:
                self.call_at(free_ns, self._send_all, host, outcome.sends, outcome.end)
            else:
                self._send_all(host, outcome.sends, outcome.end)
        # A node changes its next wake only while it runs a pipeline.
        wake_mono_ns = runner.node.next_wake_ns()
        if wake_mono_ns != runner.wake_mono_ns:
            runner.set_wake(wake_mono_ns)
        if runner.inbox.message_count:
            self._schedule(runner, free_ns)
        elif (wake_ns := runner.wake_ns) is not None:
            self._schedule(runner, max(wake_ns, free_ns))

    def _send_all(self, host: VirtualHost, sends: Sequence[Send], now: Now) -> None:
        write, unrecorded = host.recorder.write, host.unrecorded
        for send in sends:
            channel = send.channel
            if channel not in unrecorded:  # does what `record` does, but without a call for each message
                write(channel, WIRE_DECODERS[channel](send.payload) if channel in WIRE_DECODERS else send.payload, now)
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
            self.call_at(due_ns, self._arrive, link, send.channel, self._other[host.side])

    def _arrive(self, link: VirtualLink, channel: str, side: str) -> None:
        for payload, peer in link.line.pop_due(self.true_ns):
            self.deliver(side, channel, payload, peer)


def modelled_clock_source(clock: HostClock, host: str, error_s: float, bound_s: float) -> Callable[[int], ClockReport]:
    """Return a model of chrony on a virtual host: its correction has the error `error_s` and the bound `bound_s`."""

    def report(true_ns: int) -> ClockReport:
        now = clock.now_at(true_ns)
        ahead_ns = now.wall_ns - (clock.wall_start_ns + true_ns)
        return ClockReport(now.mono_ns, now.wall_ns, host, "model", -ahead_ns / NS_PER_S + error_s, bound_s)

    return report
