"""What netem is to do: laws, the flows that they are for, and what is refused. `netem_tc.py` says it to tc."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Final, Literal

from lavt.errors import UserError
from lavt.value import value

ORDER_RATE_BPS: Final = 10_000_000_000
"""The rate of a flow without one: netem keeps order only where it has a rate. A packet costs a microsecond."""

Distribution = Literal["normal", "uniform", "pareto", "paretonormal"]
DISTRIBUTIONS: Final[tuple[Distribution, ...]] = ("normal", "uniform", "pareto", "paretonormal")


@value
class Impairment:
    """What happens to the packets of a flow; all zero is nothing."""

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    """Standard deviation; of a uniform law the half width."""
    jitter_correlation: float = 0.0
    """Of the delay with itself 20 ms before; see `netem_wander.py`."""
    jitter_distribution: Distribution = "normal"
    loss: float = 0.0
    loss_burst_packets: float = 0.0
    """Mean length of a burst (Gilbert and Elliott's model); 0 or 1: each packet is lost by itself."""
    rate_bps: int = 0
    """0: no limit."""
    reorder: float = 0.0
    """Share of packets that are not delayed, and so overtake."""

    @property
    def is_transparent(self) -> bool:
        """Whether nothing happens to a packet."""
        return not (self.delay_ms or self.jitter_ms or self.loss or self.rate_bps or self.reorder)

    @property
    def longest_ms(self) -> float:
        """A delay that next to no packet exceeds."""
        return self.delay_ms + 4 * self.jitter_ms


@value
class ImpairedFlow:
    """Packets of one protocol from (`source`) or to (`destination`) a port, as one machine sends them."""

    name: Literal["video", "control", "state"]
    protocol: Literal["udp", "tcp"]
    port: int
    end: Literal["source", "destination"]
    impairment: Impairment

    @property
    def description(self) -> str:
        """The flow in words."""
        return f"{self.name} ({self.protocol} {self.end} port {self.port})"


@value
class ExemptPort:
    """A port that must never be held, and service it is."""

    protocol: Literal["udp", "tcp"]
    port: int
    service: str


ALWAYS_EXEMPT: Final = (ExemptPort("udp", 123, "NTP"), ExemptPort("tcp", 22, "ssh"))
"""Never held on any machine; the clock probe's port is added by whoever knows it."""


def check_impairment(name: str, impairment: Impairment) -> None:
    """Raise `UserError` for what contradicts itself, whoever is to do it."""
    numbers = [getattr(impairment, each.name) for each in fields(impairment) if each.name != "jitter_distribution"]
    if not all(math.isfinite(number) and number >= 0 for number in numbers):
        raise UserError(f"{name}: no quantity of a impairment is below zero or infinite: correct {impairment}")
    if max(impairment.loss, impairment.reorder, impairment.jitter_correlation) >= 1:
        raise UserError(f"{name}: loss, reorder and jitter_correlation are shares below 1: correct {impairment}")
    if impairment.jitter_distribution not in DISTRIBUTIONS:
        raise UserError(f"{name}: jitter_distribution is one of {', '.join(DISTRIBUTIONS)}")
    if impairment.jitter_correlation and impairment.jitter_distribution != "normal":
        raise UserError(f"{name}: correlated jitter is normal: give jitter_distribution normal, or no correlation")
    if impairment.loss_burst_packets > 1 and gilbert(impairment)[0] > 1:
        raise UserError(
            f"{name}: a loss of {impairment.loss:g} in bursts of {impairment.loss_burst_packets:g} packets leaves no room between "
            "them: give longer bursts or less loss"
        )
    if impairment.rate_bps and not 8 <= impairment.rate_bps <= ORDER_RATE_BPS:
        raise UserError(
            f"{name}: rate_bps is between 8 and {ORDER_RATE_BPS}, or 0 for no limit, not {impairment.rate_bps}"
        )


def check_netem_impairment(name: str, impairment: Impairment) -> None:
    """Raise `UserError` for what contradicts itself, and for what netem cannot do."""
    check_impairment(name, impairment)
    if impairment.jitter_ms > impairment.delay_ms:
        raise UserError(
            f"{name}: a jitter of {impairment.jitter_ms:g} ms on a delay of {impairment.delay_ms:g} ms would need delays below zero: "
            "give a longer delay or less jitter"
        )
    if impairment.reorder and not impairment.delay_ms:
        raise UserError(f"{name}: packets overtake by not being delayed, so reorder needs a delay: give one")
    if impairment.jitter_correlation and not impairment.jitter_ms:
        raise UserError(f"{name}: correlated jitter needs jitter_ms: give it, or no correlation")


def check_flows(flows: Sequence[ImpairedFlow], exempt: Sequence[ExemptPort] = ()) -> None:
    """Raise `UserError` for a law that netem cannot do, and for a flow that covers what must never be held."""
    if not flows:
        raise UserError("there is no flow to hold: name at least one")
    taken: dict[tuple[str, int, str], ImpairedFlow] = {}
    for flow in flows:
        check_netem_impairment(flow.name, flow.impairment)
        if not 1 <= flow.port <= 65_535:
            raise UserError(f"{flow.name}: {flow.port} is no port: give one between 1 and 65535")
        for port in (*ALWAYS_EXEMPT, *exempt):
            if (flow.protocol, flow.port) == (port.protocol, port.port):
                raise UserError(
                    f"{flow.description} would cover {port.service} (port {port.port}), which must never be delayed: "
                    "give one of the two another port"
                )
        other = taken.setdefault((flow.protocol, flow.port, flow.end), flow)
        if other is not flow:
            raise UserError(
                f"{flow.description} has the same packets as {other.description}: give one of the two another port"
            )
    if len({flow.name for flow in flows}) < len(flows):
        raise UserError("two flows have one name: name each once")


def bursts(impairment: Impairment) -> bool:
    """Whether packets are lost in bursts."""
    return impairment.loss > 0 and impairment.loss_burst_packets > 1


def gilbert(impairment: Impairment) -> tuple[float, float]:
    """Give the chances of a burst's begin and end at a packet that lead to a law's loss and mean burst."""
    ends = 1 / impairment.loss_burst_packets
    return impairment.loss * ends / (1 - impairment.loss), ends
