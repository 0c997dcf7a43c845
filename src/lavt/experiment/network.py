"""What the network of a run does: the latency that is there anyway, and what is injected, as delay laws."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.config import Condition, Costs
from lavt.transport.delay import DelayLaw, Lognormal

US_PER_MS = 1000.0

STAMP_TO_STAMP = (
    ("camera", "stamp"),
    ("camera", "encode"),
    ("camera", "packetize"),
    ("driver", "wait_access_unit"),
    ("driver", "decode"),
    ("driver", "read_stamp"),
)
"""Hops that tau_v contains: a profile's link delay is its total less these."""
SENT_TO_RECEIVED = (("driver", "command"),)
"""Hops that tau_c contains."""


@dataclass(frozen=True, slots=True)
class Inherent:
    """A named profile of the latency that is there without injection: the whole of tau_v and tau_c."""

    video_ms: float
    video_jitter: Lognormal
    control_ms: float


INHERENT = {
    # The paper's WiFi 5: tau_v with median 62 and 95th percentile 86 ms, tau_c of 8 to 10 ms.
    "paper_wifi5": Inherent(50.0, Lognormal(12.0, 0.668), 9.0),
}


@dataclass(frozen=True, slots=True)
class Network:
    """How long things take: video, state (server to client), control (client to server), and what is never held."""

    video: DelayLaw
    control: DelayLaw
    state: DelayLaw
    unheld: DelayLaw


def injected_network(profile: str, condition: Condition, costs: Costs, seed: int, *, state_delay: str) -> Network:
    """Give what must be injected on a loopback to have `condition` on top of the inherent `profile`.

    `profile` "loopback" adds nothing: the machine's own latency is there anyway.
    """
    inherent = INHERENT.get(profile)
    video_ms, jitter, control_ms = 0.0, None, 0.0
    if inherent is not None:
        video_ms = inherent.video_ms - costs.links_us["video"] / US_PER_MS - _hops_ms(costs, STAMP_TO_STAMP)
        jitter = inherent.video_jitter
        control_ms = inherent.control_ms - costs.links_us["control"] / US_PER_MS - _hops_ms(costs, SENT_TO_RECEIVED)
    state_ms = condition.video_ms if state_delay == "with_video" else 0.0
    return Network(
        DelayLaw(max(0.0, video_ms) + condition.video_ms, jitter, seed, "video inherent"),
        DelayLaw(max(0.0, control_ms) + condition.control_ms),
        DelayLaw(max(0.0, control_ms) + state_ms),
        DelayLaw(0.0),
    )


def virtual_network(injected: Network, costs: Costs) -> Network:
    """Add what a real loopback has by itself, as measured."""
    return Network(
        _later(injected.video, costs.links_us["video"]),
        _later(injected.control, costs.links_us["control"]),
        _later(injected.state, costs.links_us["state"]),
        _later(injected.unheld, costs.links_us["state"]),
    )


def _later(law: DelayLaw, by_us: float) -> DelayLaw:
    return DelayLaw(law.constant_ms + by_us / US_PER_MS, law.jitter, law.seed, law.name)


def _hops_ms(costs: Costs, hops: tuple[tuple[str, str], ...]) -> float:
    return sum(costs.hops_us.get(node, {}).get(hop, 0.0) for node, hop in hops) / US_PER_MS
