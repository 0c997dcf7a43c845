"""An emulated link without input and output: it decides which packets are lost and when the others leave.

The virtual runtime and the relay use it. It emulates netem as `docs/netem.md` describes it, in the kernel's order.
First the link decides whether a packet is lost. A share of the other packets is reordered: these packets are not
delayed. The rest wait in order, first for their delay and then for the rate. Unlike netem, the link can also take the
delay or the capacity from a trace. Each impairment draws from its own random-number stream, by packet number or by time
slot. So an additional impairment does not change the draws of the other impairments, and two runs with one seed get the
same draws.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.emulation.impairment import (
    QUEUE_PACKETS,
    Impairment,
    burst_probabilities,
    check_impairment,
    has_loss_bursts,
)
from lavt.transport.emulation.random_process import QUANTILES, CorrelatedProcess, Draws, LossProcess, quantiles
from lavt.transport.emulation.trace import OPPORTUNITY_BYTES, CapacityTrace, DelayTrace, Trace

HEADER_BYTES: Final = 42
"""Ethernet, IPv4 and UDP headers, which netem counts in addition to the payload."""
SLOT_NS: Final = 20 * NS_PER_MS
"""Correlated jitter changes once per slot."""


@dataclass(frozen=True, slots=True)
class LinkInjection:
    """The impairment of one direction of a flow; `name` is the prefix of its random-number streams."""

    impairment: Impairment
    seed: int
    name: str
    trace: Trace | None = None
    queue_packets: int = QUEUE_PACKETS
    """How many packets can wait for the rate or the capacity; further ones are dropped."""


def check_injection(injected: LinkInjection) -> None:
    """Raise `UserError` for contradictory values. Jitter can be larger than the delay: a negative delay becomes 0."""
    impairment, name = injected.impairment, injected.name
    check_impairment(name, impairment)
    if impairment.reorder and not (
        impairment.delay_ms or impairment.jitter_ms or isinstance(injected.trace, DelayTrace)
    ):
        raise UserError(f"{name}: packets overtake by not being delayed, so reorder needs a delay: give one")
    if impairment.rate_bps and isinstance(injected.trace, CapacityTrace):
        raise UserError(f"{name}: rate_bps and a capacity trace both limit the rate: give one of the two")


class EmulatedLink:
    """One direction of an emulated link; times are on the caller's clock, and a trace begins at `start_ns`.

    Public counters, in packets: `packets` arrived. Of these, `lost` were lost at random, `dropped` were dropped because
    the queue was full, and `overtook` left before an earlier packet.
    """

    def __init__(self, injected: LinkInjection, start_ns: int = 0) -> None:
        impairment, seed, name = injected.impairment, injected.seed, injected.name
        self.lost = self.dropped = self.overtook = self.packets = 0
        self._impairment, self._start_ns = impairment, start_ns
        bursts = burst_probabilities(impairment) if has_loss_bursts(impairment) else None
        self._losses = LossProcess(seed, f"{name} loss", impairment.loss, bursts)
        self._reorder_draws = Draws(seed, f"{name} reorder")
        self._jitter_draws = Draws(seed, f"{name} jitter")
        self._correlated_jitter = CorrelatedProcess(seed, f"{name} wander", impairment.jitter_correlation)
        self._jitter_quantiles = quantiles(impairment.jitter_distribution)
        self._delays = injected.trace if isinstance(injected.trace, DelayTrace) else None
        capacity = injected.trace if isinstance(injected.trace, CapacityTrace) else None
        self._bottleneck = Bottleneck(injected.queue_packets, impairment.rate_bps, capacity, start_ns)
        self._reordered_departure_ns = start_ns
        """When the last reordered packet left."""
        self._delay_end_ns = start_ns
        """When the delay of the last delayed packet ended."""
        self._delayed_departure_ns = start_ns
        """When the last delayed packet left, after it had waited for the rate."""

    @property
    def counts(self) -> dict[str, int]:
        """The counters by name."""
        return {name: getattr(self, name) for name in ("packets", "lost", "dropped", "overtook")}

    def departure_ns(self, arrived_ns: int, inherent_ns: int, size_bytes: int) -> int | None:
        """Return when a packet with a payload of `size_bytes` leaves, or None if it is lost.

        `inherent_ns` is the link's own delay, to which the injected delay is added.
        """
        number = self.packets
        self.packets += 1
        impairment = self._impairment
        if impairment.loss and self._losses.is_lost(number):
            self.lost += 1
            return None
        if impairment.reorder and self._reorder_draws.at(number) < impairment.reorder:
            self._reordered_departure_ns = max(arrived_ns + inherent_ns, self._reordered_departure_ns)
            self.overtook += self._reordered_departure_ns < self._delayed_departure_ns
            return self._reordered_departure_ns
        delay_ns = max(0, inherent_ns + self._injected_ns(arrived_ns, number))
        self._delay_end_ns = max(arrived_ns + delay_ns, self._delay_end_ns)
        departure_ns = self._bottleneck.departure_ns(self._delay_end_ns, size_bytes + HEADER_BYTES)
        if departure_ns is None:
            self.dropped += 1
            return None
        self._delayed_departure_ns = departure_ns
        return departure_ns

    def _injected_ns(self, arrived_ns: int, number: int) -> int:
        """Return the injected delay; jitter can make it negative."""
        impairment, elapsed_ns = self._impairment, max(0, arrived_ns - self._start_ns)
        delay_ms = impairment.delay_ms
        if impairment.jitter_ms and impairment.jitter_correlation:
            delay_ms += impairment.jitter_ms * self._correlated_jitter.at(elapsed_ns // SLOT_NS)
        elif impairment.jitter_ms:
            delay_ms += impairment.jitter_ms * self._jitter_quantiles[int(self._jitter_draws.at(number) * QUANTILES)]
        return round(delay_ms * NS_PER_MS) + (0 if self._delays is None else self._delays.delay_ns(elapsed_ns))


class Bottleneck:
    """A queue of limited length for packets that wait for a rate or a capacity; without either, no packet waits."""

    def __init__(self, queue_packets: int, rate_bps: int, capacity: CapacityTrace | None, start_ns: int) -> None:
        self._queue_packets, self._rate_bps, self._capacity, self._start_ns = (
            queue_packets,
            rate_bps,
            capacity,
            start_ns,
        )
        self._departures_ns: deque[int] = deque()
        """Departure times of the packets in the queue."""
        self._free_ns = start_ns
        """When all packets that have arrived so far have been sent at the rate."""
        self._opportunity, self._left_bytes = -1, 0
        """The number of the last opportunity that was used, and the bytes left in it."""

    def departure_ns(self, arrived_ns: int, size_bytes: int) -> int | None:
        """Return when a packet that arrives at `arrived_ns` leaves, in order, or None if the queue is full."""
        if not (self._rate_bps or self._capacity):
            return arrived_ns
        while self._departures_ns and self._departures_ns[0] <= arrived_ns:
            self._departures_ns.popleft()
        if len(self._departures_ns) >= self._queue_packets:
            return None
        departure_ns = (
            self._rate_departure_ns(arrived_ns, size_bytes)
            if self._capacity is None
            else self._start_ns + self._capacity_departure_ns(self._capacity, arrived_ns - self._start_ns, size_bytes)
        )
        self._departures_ns.append(departure_ns)
        return departure_ns

    def _rate_departure_ns(self, arrived_ns: int, size_bytes: int) -> int:
        """Return when a packet has been sent at the rate, after all earlier packets."""
        duration_ns = round(8 * size_bytes * NS_PER_S / self._rate_bps)
        self._free_ns = max(arrived_ns, self._free_ns) + duration_ns
        return self._free_ns

    def _capacity_departure_ns(self, capacity: CapacityTrace, elapsed_ns: int, size_bytes: int) -> int:
        """Return when a packet's last byte is delivered, as a time since the start of the trace.

        As in Mahimahi, the rest of an opportunity goes to the next packet only if that packet is already waiting.
        """
        first = capacity.first_at(elapsed_ns)
        if first > self._opportunity:
            self._opportunity, self._left_bytes = first, OPPORTUNITY_BYTES
        while size_bytes > self._left_bytes:
            size_bytes -= self._left_bytes
            self._opportunity, self._left_bytes = self._opportunity + 1, OPPORTUNITY_BYTES
        self._left_bytes -= size_bytes
        return capacity.time_ns(self._opportunity)
