"""A link with more than a delay, without input and output: what is lost, what waits, and when each packet leaves.

Virtual time and the relay use it. It does what netem does as `docs/netem.md` has it, in the kernel's order: a packet is
lost or not; of the others a share overtakes; the rest take their delay in order, and then the rate. Beyond netem a
trace gives delay or capacity. All chance is drawn by the packet's number, or by the time slot, from a stream for each
impairment: one law more leaves what the others do as it was, and runs with one seed stay paired.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.emulation.impairment import Impairment, bursts, check_impairment, gilbert
from lavt.transport.emulation.random_process import QUANTILES, CorrelatedProcess, Draws, LossProcess, quantiles
from lavt.transport.emulation.trace import OPPORTUNITY_BYTES, CapacityTrace, DelayTrace, Trace

HEADER_BYTES: Final = 42
"""Ethernet, IPv4 and UDP: what netem counts of a datagram beside its payload."""
QUEUE_PACKETS: Final = 10_000
"""As much as our netem has room for."""
SLOT_NS: Final = 20 * NS_PER_MS
"""Correlated jitter becomes a new one so often."""


@dataclass(frozen=True, slots=True)
class LinkInjection:
    """What is injected into one direction of a flow; `name` begins the names of its streams of `seed`."""

    impairment: Impairment
    seed: int
    name: str
    trace: Trace | None = None
    queue_packets: int = QUEUE_PACKETS
    """So many wait for rate or capacity; what comes then is dropped."""


def check_injection(injected: LinkInjection) -> None:
    """Raise `UserError` for what contradicts itself. Jitter beyond the delay does not: no delay is below zero."""
    impairment, name = injected.impairment, injected.name
    check_impairment(name, impairment)
    if impairment.reorder and not (
        impairment.delay_ms or impairment.jitter_ms or isinstance(injected.trace, DelayTrace)
    ):
        raise UserError(f"{name}: packets overtake by not being delayed, so reorder needs a delay: give one")
    if impairment.rate_bps and isinstance(injected.trace, CapacityTrace):
        raise UserError(f"{name}: rate_bps and a trace of capacity both say how much passes: give one of the two")


class EmulatedLink:
    """One direction of a link; times are those of whoever uses it, and a trace begins at `start_ns`.

    Public counters, in packets: `lost` by chance, `dropped` because the queue was full, `overtook` others.
    """

    def __init__(self, injected: LinkInjection, start_ns: int = 0) -> None:
        impairment, seed, name = injected.impairment, injected.seed, injected.name
        self.lost = self.dropped = self.overtook = self.packets = 0
        self._law, self._start_ns = impairment, start_ns
        self._losses = LossProcess(
            seed, f"{name} loss", impairment.loss, gilbert(impairment) if bursts(impairment) else None
        )
        self._early = Draws(seed, f"{name} reorder")
        self._jitter = Draws(seed, f"{name} jitter")
        self._wander = CorrelatedProcess(seed, f"{name} wander", impairment.jitter_correlation)
        self._deviations = quantiles(impairment.jitter_distribution)
        self._delays = injected.trace if isinstance(injected.trace, DelayTrace) else None
        capacity = injected.trace if isinstance(injected.trace, CapacityTrace) else None
        self._bottleneck = Bottleneck(injected.queue_packets, impairment.rate_bps, capacity, start_ns)
        self._early_ns = self._delayed_ns = self._last_ns = start_ns
        """When the last early one left, when the last one had its delay behind it, and when it left."""

    @property
    def counts(self) -> dict[str, int]:
        """The counters by name."""
        return {name: getattr(self, name) for name in ("packets", "lost", "dropped", "overtook")}

    def leaves_ns(self, arrived_ns: int, inherent_ns: int, size_bytes: int) -> int | None:
        """Tell when a packet with so large a payload leaves that has just arrived; None: it is lost.

        `inherent_ns` is the delay that is there anyway, below what is injected.
        """
        number = self.packets
        self.packets += 1
        impairment = self._law
        if impairment.loss and self._losses.takes(number):
            self.lost += 1
            return None
        if impairment.reorder and self._early.at(number) < impairment.reorder:
            self._early_ns = max(arrived_ns + inherent_ns, self._early_ns)
            self.overtook += self._early_ns < self._last_ns
            return self._early_ns
        delay_ns = max(0, inherent_ns + self._injected_ns(arrived_ns, number))
        self._delayed_ns = max(arrived_ns + delay_ns, self._delayed_ns)
        left_ns = self._bottleneck.leaves_ns(self._delayed_ns, size_bytes + HEADER_BYTES)
        if left_ns is None:
            self.dropped += 1
            return None
        self._last_ns = left_ns
        return left_ns

    def _injected_ns(self, arrived_ns: int, number: int) -> int:
        """Give the delay that is injected; with jitter it can be below zero."""
        impairment, gone_ns = self._law, max(0, arrived_ns - self._start_ns)
        delay_ms = impairment.delay_ms
        if impairment.jitter_ms and impairment.jitter_correlation:
            delay_ms += impairment.jitter_ms * self._wander.at(gone_ns // SLOT_NS)
        elif impairment.jitter_ms:
            delay_ms += impairment.jitter_ms * self._deviations[int(self._jitter.at(number) * QUANTILES)]
        return round(delay_ms * NS_PER_MS) + (0 if self._delays is None else self._delays.delay_ns(gone_ns))


class Bottleneck:
    """A queue with room for so many packets in front of a rate, a capacity, or neither: then nothing waits."""

    def __init__(self, room: int, rate_bps: int, capacity: CapacityTrace | None, start_ns: int) -> None:
        self._room, self._rate_bps, self._capacity, self._start_ns = room, rate_bps, capacity, start_ns
        self._leaving_ns: deque[int] = deque()
        """When each of those in the queue will have left."""
        self._free_ns = start_ns
        self._number, self._left_bytes = -1, 0
        """The opportunity that was used last, and what it has left."""

    def leaves_ns(self, arrived_ns: int, size_bytes: int) -> int | None:
        """Tell when a packet is through that comes at a time, not before the one before it; None: there is no room."""
        if not (self._rate_bps or self._capacity):
            return arrived_ns
        while self._leaving_ns and self._leaving_ns[0] <= arrived_ns:
            self._leaving_ns.popleft()
        if len(self._leaving_ns) >= self._room:
            return None
        left_ns = self._sent_ns(arrived_ns, size_bytes) if self._capacity is None else (
            self._start_ns + self._delivered_ns(self._capacity, arrived_ns - self._start_ns, size_bytes)
        )  # fmt: skip
        self._leaving_ns.append(left_ns)
        return left_ns

    def _sent_ns(self, arrived_ns: int, size_bytes: int) -> int:
        """One after the other at the rate."""
        takes_ns = round(8 * size_bytes * NS_PER_S / self._rate_bps)
        self._free_ns = max(arrived_ns, self._free_ns) + takes_ns
        return self._free_ns

    def _delivered_ns(self, capacity: CapacityTrace, gone_ns: int, size_bytes: int) -> int:
        """Use up opportunities, as Mahimahi does: the rest of one is for the next packet if that waits by then."""
        first = capacity.first_from(gone_ns)
        if first > self._number:
            self._number, self._left_bytes = first, OPPORTUNITY_BYTES
        while size_bytes > self._left_bytes:
            size_bytes -= self._left_bytes
            self._number, self._left_bytes = self._number + 1, OPPORTUNITY_BYTES
        self._left_bytes -= size_bytes
        return capacity.time_ns(self._number)
