"""The impaired link between the two processes of a run, which delays every datagram and loses some.

Jitter and loss of a video packet depend only on its number, so that LAVT and GStreamer get the same impairment.
Datagrams from the receiving process, and those of the path validation, get only the constant delay.
"""

from __future__ import annotations

import heapq
import json
import os
import select
import socket
import sys
import time  # noqa: TID251 (the relay delays datagrams)
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass

import numpy as np
from benchmarks.video.processes import WARM_UP_FRAMES
from benchmarks.video.run import exclude_objects_from_gc, print_json, requested_run

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.emulation.impairment import Impairment, burst_probabilities
from lavt.transport.emulation.random_process import Draws, LossProcess

ONE_WAY_MS = 20
BUFFER_BYTES = 4 * 1024 * 1024
MAX_DATAGRAM_BYTES = 65_535
SEED = 6
MEDIA, REPAIR = 96, 97
"""Payload types of RTP packets."""
MARKER = 0x80
"""A bit in the byte of the payload type, which is set in the last packet of a frame."""

Address = tuple[str, int]


@dataclass(frozen=True)
class LinkCase:
    """The impairment of the link in addition to its 20 ms each way."""

    name: str
    jitter_ms: float = 0.0
    """The longest further delay. The delays of packets are independent and uniform, so that packets are reordered."""
    loss: float = 0.0
    """Share of packets that are lost."""
    burst_packets: float = 0.0
    """Mean number of packets in a burst of losses; 0 if packets are lost independently."""

    def to_json(self) -> str:
        """Return the case as JSON for the relay's command line."""
        return json.dumps(asdict(self))


class PacketImpairment:
    """The delays and losses of the video's packets."""

    def __init__(self, case: LinkCase) -> None:
        impairment = Impairment(loss=case.loss, loss_burst_packets=case.burst_packets)
        bursts = burst_probabilities(impairment) if case.burst_packets else None
        self._losses = LossProcess(SEED, "loss", case.loss, bursts)
        self._jitter = Draws(SEED, "jitter")
        self._jitter_ns = case.jitter_ms * NS_PER_MS
        self._number = 0

    def next_delay_ns(self) -> int | None:
        """Return the further delay of the next packet, or None if it is lost."""
        number = self._number
        self._number += 1
        lost = self._losses.is_lost(number)
        return None if lost else round(self._jitter.at(number) * self._jitter_ns)


class TrafficCounter:
    """Counters of the video's packets after the warm-up, and the lateness of all datagrams."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.late_ms: list[float] = []
        """For each datagram, how much later than due it was forwarded: an error of this machine, not the impairment."""
        self._complete_frames = 0

    def note(self, datagram: bytes, *, lost: bool) -> None:
        """Count an RTP packet by its payload type; ignore RTCP."""
        payload_type = datagram[1] & ~MARKER
        self._complete_frames += payload_type == MEDIA and bool(datagram[1] & MARKER)
        if self._complete_frames < WARM_UP_FRAMES or payload_type not in (MEDIA, REPAIR):
            return
        name = "media" if payload_type == MEDIA else "repair"
        self.counts[f"{name}_bytes"] += len(datagram)
        self.counts[f"{name}_packets"] += 1
        self.counts[f"{name}_lost"] += lost


def relay(
    near: socket.socket, far: socket.socket, far_peer: Address, case: LinkCase, *, near_sends: bool
) -> TrafficCounter:
    """Relay datagrams between two peers until a line arrives on stdin.

    The socket `near` is for the near peer, whose address is known from its first datagram, and `far` is for `far_peer`.
    With `near_sends` the video comes from the near peer, otherwise from the far peer.
    """
    impairment, traffic = PacketImpairment(case), TrafficCounter()
    waiting: list[tuple[int, int, bytes, socket.socket, Address]] = []
    """A heap of due time, number, datagram, sending socket and receiving peer."""
    near_peer: Address | None = None
    number = 0
    while True:
        next_due_ns = waiting[0][0] if waiting else time.monotonic_ns() + NS_PER_S
        pause_s = max(0.0, (next_due_ns - time.monotonic_ns()) / NS_PER_S)
        ready, _, _ = select.select((near, far, sys.stdin), (), (), pause_s)
        if sys.stdin in ready:
            return traffic
        for receiver in (near, far):
            if receiver not in ready:
                continue
            datagram, address = receiver.recvfrom(MAX_DATAGRAM_BYTES)
            due_ns = time.monotonic_ns() + ONE_WAY_MS * NS_PER_MS
            near_peer = address if receiver is near else near_peer
            is_rtp = datagram[0] >> 6 == 2  # the version of RTP and RTCP; other datagrams belong to the path validation
            comes_from_sender = (receiver is near) is near_sends
            if comes_from_sender and is_rtp:
                delay_ns = impairment.next_delay_ns()
                traffic.note(datagram, lost=delay_ns is None)
                if delay_ns is None:
                    continue
                due_ns += delay_ns
            sender, peer = (far, far_peer) if receiver is near else (near, near_peer)
            if peer is not None:
                number += 1
                heapq.heappush(waiting, (due_ns, number, datagram, sender, peer))
        while waiting and waiting[0][0] <= time.monotonic_ns():
            due_ns, _, datagram, sender, peer = heapq.heappop(waiting)
            traffic.late_ms.append((time.monotonic_ns() - due_ns) / NS_PER_MS)
            sender.sendto(datagram, peer)


def main() -> None:
    """Relay until a line arrives on stdin, then print the counters."""
    run, program, case = requested_run(), sys.argv[2], LinkCase(**json.loads(sys.argv[3]))
    near, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for endpoint in (near, far):
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        endpoint.bind(("127.0.0.1", 0))
    exclude_objects_from_gc()
    with suppress(OSError):  # the relay replaces the network, so it gets priority over both processes if permitted
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    print_json({"port": near.getsockname()[1]})
    traffic = relay(near, far, ("127.0.0.1", run.port), case, near_sends=program == "gstreamer")
    late_ms = traffic.late_ms or [0.0]
    print_json({**traffic.counts, "late_p99_ms": float(np.percentile(late_ms, 99)), "late_max_ms": max(late_ms)})


if __name__ == "__main__":
    main()
