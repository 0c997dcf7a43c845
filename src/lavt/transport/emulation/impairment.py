"""Impairments of a network, and the flows to which they apply. `transport/netem/tc.py` translates both for tc."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

from msgspec import Struct

from lavt.errors import UserError

ORDER_RATE_BPS: Final = 10_000_000_000
"""The rate that netem gets for a flow without a rate limit, because netem keeps packets in order only if it has a rate.
This rate adds 1 us to the delay of each packet."""
QUEUE_PACKETS: Final = 10_000
"""The queue limit that LAVT gives to netem."""

Distribution = Literal["normal", "uniform", "pareto", "paretonormal"]
DISTRIBUTIONS: Final[tuple[Distribution, ...]] = ("normal", "uniform", "pareto", "paretonormal")


class Impairment(Struct, frozen=True):
    """What a network does to the packets of a flow; by default nothing."""

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    """Standard deviation of the delay; for a uniform distribution half of its width."""
    jitter_correlation: float = 0.0
    """Correlation of the delay with the delay 20 ms before; see `transport/netem/correlated_jitter.py`."""
    jitter_distribution: Distribution = "normal"
    loss: float = 0.0
    loss_burst_packets: float = 0.0
    """Mean length of a loss burst (Gilbert-Elliott model); with 0 or 1 each packet is lost independently."""
    rate_bps: int = 0
    """The largest bit rate; 0: no limit."""
    reorder: float = 0.0
    """Share of packets that are not delayed, and therefore overtake earlier packets."""

    @property
    def is_transparent(self) -> bool:
        """Whether packets pass unchanged."""
        return not (self.delay_ms or self.jitter_ms or self.loss or self.rate_bps or self.reorder)

    @property
    def longest_ms(self) -> float:
        """A delay that hardly any packet exceeds: the mean plus four standard deviations."""
        return self.delay_ms + 4 * self.jitter_ms


class ImpairedFlow(Struct, frozen=True):
    """The packets of one protocol that a machine sends with `port` as their source or destination port (`end`)."""

    name: Literal["video", "control", "state"]
    protocol: Literal["udp", "tcp"]
    port: int
    end: Literal["source", "destination"]
    impairment: Impairment

    @property
    def description(self) -> str:
        """Name, protocol and port of the flow, for messages."""
        return f"{self.name} ({self.protocol} {self.end} port {self.port})"


class ExemptPort(Struct, frozen=True):
    """A port whose packets must never be delayed, and the service that uses it."""

    protocol: Literal["udp", "tcp"]
    port: int
    service: str


ALWAYS_EXEMPT: Final = (ExemptPort("udp", 123, "NTP"), ExemptPort("tcp", 22, "ssh"))
"""Exempt on every machine; callers add the port of the clock probe."""


def check_impairment(name: str, impairment: Impairment) -> None:
    """Raise `UserError` for values that are out of range or contradict each other."""
    numbers = [getattr(impairment, field) for field in Impairment.__struct_fields__ if field != "jitter_distribution"]
    if not all(math.isfinite(number) and number >= 0 for number in numbers):
        raise UserError(f"{name}: all values must be finite and not negative, unlike in {impairment}")
    if max(impairment.loss, impairment.reorder, impairment.jitter_correlation) >= 1:
        raise UserError(f"{name}: loss, reorder and jitter_correlation must be below 1, unlike in {impairment}")
    if impairment.jitter_distribution not in DISTRIBUTIONS:
        raise UserError(f"{name}: unknown jitter_distribution: choose one of {', '.join(DISTRIBUTIONS)}")
    if impairment.jitter_correlation and impairment.jitter_distribution != "normal":
        raise UserError(f"{name}: jitter with a correlation must have the jitter_distribution normal")
    if impairment.loss_burst_packets > 1 and burst_probabilities(impairment).begin > 1:
        raise UserError(
            f"{name}: a loss of {impairment.loss:g} in bursts of {impairment.loss_burst_packets:g} packets would "
            "need gaps of less than one packet between the bursts: give longer bursts or less loss"
        )
    if impairment.rate_bps and not 8 <= impairment.rate_bps <= ORDER_RATE_BPS:
        raise UserError(
            f"{name}: rate_bps is between 8 and {ORDER_RATE_BPS}, or 0 for no limit, not {impairment.rate_bps}"
        )


def check_netem_impairment(name: str, impairment: Impairment) -> None:
    """Raise `UserError` for an inconsistent impairment, and for one that netem cannot produce."""
    check_impairment(name, impairment)
    if impairment.jitter_ms > impairment.delay_ms:
        raise UserError(
            f"{name}: a jitter of {impairment.jitter_ms:g} ms on a delay of {impairment.delay_ms:g} ms would need "
            "negative delays: give a longer delay or less jitter"
        )
    if impairment.reorder and not impairment.delay_ms:
        raise UserError(f"{name}: packets overtake by not being delayed, so reorder needs a delay: give one")
    if impairment.jitter_correlation and not impairment.jitter_ms:
        raise UserError(f"{name}: correlated jitter needs jitter_ms: give it, or no correlation")


def check_flows(flows: Sequence[ImpairedFlow], exempt: Sequence[ExemptPort] = ()) -> None:
    """Raise `UserError` for an impairment that netem cannot produce, or a flow that covers an exempt port."""
    if not flows:
        raise UserError("there is no flow to delay: name at least one")
    flow_of_packets: dict[tuple[str, int, str], ImpairedFlow] = {}
    for flow in flows:
        check_netem_impairment(flow.name, flow.impairment)
        if not 1 <= flow.port <= 65_535:
            raise UserError(f"{flow.name}: {flow.port} is not a port number: give one between 1 and 65535")
        for exempt_port in (*ALWAYS_EXEMPT, *exempt):
            if (flow.protocol, flow.port) == (exempt_port.protocol, exempt_port.port):
                raise UserError(
                    f"{flow.description} would cover {exempt_port.service} (port {exempt_port.port}), "
                    "which must never be delayed: give one of the two another port"
                )
        other = flow_of_packets.setdefault((flow.protocol, flow.port, flow.end), flow)
        if other is not flow:
            raise UserError(
                f"{flow.description} selects the same packets as {other.description}: give one of them another port"
            )
    if len({flow.name for flow in flows}) < len(flows):
        raise UserError("two flows have the same name: name each once")


def has_loss_bursts(impairment: Impairment) -> bool:
    """Return whether packets are lost in bursts."""
    return impairment.loss > 0 and impairment.loss_burst_packets > 1


class BurstProbabilities(NamedTuple):
    """The probabilities of the Gilbert-Elliott model, per packet: that a loss burst begins, and that it ends."""

    begin: float
    end: float


def burst_probabilities(impairment: Impairment) -> BurstProbabilities:
    """Return the probabilities that result in the impairment's loss and mean burst length."""
    end = 1 / impairment.loss_burst_packets
    return BurstProbabilities(impairment.loss * end / (1 - impairment.loss), end)
