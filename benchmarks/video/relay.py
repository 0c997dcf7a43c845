"""The impaired link between the two processes of a run, of either side: every datagram waits, some are lost.

What comes from the sender is delayed and lost by the packet's number, so that both sides meet the same law with the
same chance; what goes back is delayed alike, and datagrams that only prove the path are not lost.
"""

from __future__ import annotations

import heapq
import json
import os
import select
import socket
import sys
import time  # noqa: TID251 (what it holds back is timed)
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass

import numpy as np
from benchmarks.video.run import freeze, requested_run, tell
from benchmarks.video.sides import WARM_UP_FRAMES

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.emulation.impairment import Impairment, gilbert
from lavt.transport.emulation.random_process import Draws, LossProcess

ONE_WAY_MS = 20
BUFFER_BYTES = 4 * 1024 * 1024
LONGEST_DATAGRAM = 65_535
SEED = 6
MEDIA, REPAIR = 96, 97
"""Payload types of RTP."""
MARKER = 0x80

Address = tuple[str, int]


@dataclass(frozen=True)
class Case:
    """What the link does beside its 20 ms each way."""

    name: str
    jitter_ms: float = 0.0
    """A further delay, uniform from 0 to this, for each packet by itself: they overtake each other."""
    loss: float = 0.0
    burst_packets: float = 0.0
    """Mean length of a burst; 0: each packet is lost by itself."""

    def told(self) -> str:
        """Write the case for the relay's command line."""
        return json.dumps(asdict(self))


class Fate:
    """What becomes of each packet of the video."""

    def __init__(self, case: Case) -> None:
        law = Impairment(loss=case.loss, loss_burst_packets=case.burst_packets)
        self._losses = LossProcess(SEED, "loss", case.loss, gilbert(law) if case.burst_packets else None)
        self._jitter = Draws(SEED, "jitter")
        self._jitter_ns = case.jitter_ms * NS_PER_MS
        self._number = 0

    def delay_ns(self) -> int | None:
        """Give how much longer than usual the next packet takes; None: it is lost."""
        number = self._number
        self._number += 1
        lost = self._losses.is_lost(number)
        return None if lost else round(self._jitter.at(number) * self._jitter_ns)


class Tally:
    """What the sender gave to carry, after the warm-up."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.late_ms: list[float] = []
        """How much later than due each datagram left: this machine's doing, and not the law's."""
        self._frames = 0

    def note(self, datagram: bytes, *, lost: bool) -> None:
        """Count a datagram by its payload type."""
        kind = datagram[1] & ~MARKER
        self._frames += kind == MEDIA and bool(datagram[1] & MARKER)
        if self._frames < WARM_UP_FRAMES or kind not in (MEDIA, REPAIR):
            return
        name = "media" if kind == MEDIA else "repair"
        self.counts[f"{name}_bytes"] += len(datagram)
        self.counts[f"{name}_packets"] += 1
        self.counts[f"{name}_lost"] += lost


def carry(near: socket.socket, far: socket.socket, there: Address, case: Case, *, near_sends: bool) -> Tally:
    """Carry datagrams between whoever comes to `near` and the process at `there`, until a line comes on stdin."""
    fate, tally = Fate(case), Tally()
    waiting: list[tuple[int, int, bytes, socket.socket, Address]] = []
    guest: Address | None = None
    number = 0
    while True:
        pause_s = 1.0 if not waiting else max(0.0, (waiting[0][0] - time.monotonic_ns()) / NS_PER_S)
        ready, _, _ = select.select((near, far, sys.stdin), (), (), pause_s)
        if sys.stdin in ready:
            return tally
        for opened in (near, far):
            if opened not in ready:
                continue
            datagram, address = opened.recvfrom(LONGEST_DATAGRAM)
            due_ns = time.monotonic_ns() + ONE_WAY_MS * NS_PER_MS
            guest = address if opened is near else guest
            if (opened is near) is near_sends and datagram[0] >> 6 == 2:
                longer_ns = fate.delay_ns()
                tally.note(datagram, lost=longer_ns is None)
                if longer_ns is None:
                    continue
                due_ns += longer_ns
            out, to = (far, there) if opened is near else (near, guest)
            if to is not None:
                number += 1
                heapq.heappush(waiting, (due_ns, number, datagram, out, to))
        while waiting and waiting[0][0] <= time.monotonic_ns():
            due_ns, _, datagram, out, to = heapq.heappop(waiting)
            tally.late_ms.append((time.monotonic_ns() - due_ns) / NS_PER_MS)
            out.sendto(datagram, to)


def main() -> None:
    """Carry until told to end, then tell what was carried."""
    run, side, case = requested_run(), sys.argv[2], Case(**json.loads(sys.argv[3]))
    near, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for each in (near, far):
        each.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        each.bind(("127.0.0.1", 0))
    freeze()
    with suppress(OSError):  # the link is no program: where it may, it goes before both sides
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    tell({"port": near.getsockname()[1]})
    tally = carry(near, far, ("127.0.0.1", run.port), case, near_sends=side == "gstreamer")
    late_ms = tally.late_ms or [0.0]
    tell({**tally.counts, "late_p99_ms": float(np.percentile(late_ms, 99)), "late_max_ms": max(late_ms)})


if __name__ == "__main__":
    main()
