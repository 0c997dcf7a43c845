"""What the network of a run does: the latency that is there anyway, and what is injected, as laws."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lavt.assembly.links import injected
from lavt.config import Condition, Costs
from lavt.transport.emulation.delay_line import DelayModel, Lognormal
from lavt.transport.emulation.link import LinkInjection

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
class BaselineLatency:
    """A named profile of the latency that is there without injection: the whole of tau_v and tau_c."""

    video_ms: float
    video_jitter: Lognormal
    control_ms: float


INHERENT = {
    # The paper's WiFi 5: tau_v with median 62 and 95th percentile 86 ms, tau_c of 8 to 10 ms.
    "paper_wifi5": BaselineLatency(50.0, Lognormal(12.0, 0.668), 9.0),
}


@dataclass(frozen=True, slots=True)
class NetworkDelays:
    """How long things take: video, state (server to client), control (client to server), and what is never held.

    A constant delay that is injected is part of these. Where more is, all that is injected is beside them.
    """

    video: DelayModel
    control: DelayModel
    state: DelayModel
    unheld: DelayModel
    video_injected: LinkInjection | None = None
    control_injected: LinkInjection | None = None


def injected_network(profile: str, condition: Condition, costs: Costs, seed: int, *, state_delay: str) -> NetworkDelays:
    """Give what must be injected on a loopback to have `condition` on top of the inherent `profile`.

    `profile` "loopback" adds nothing: the machine's own latency is there anyway. Raises `UserError` for a condition
    that contradicts itself, and for a trace that is missing or wrong.
    """
    inherent = INHERENT.get(profile)
    video_ms, jitter, control_ms = 0.0, None, 0.0
    if inherent is not None:
        video_ms = inherent.video_ms - costs.links_us["video"] / US_PER_MS - _stages_ms(costs, STAMP_TO_STAMP)
        jitter = inherent.video_jitter
        control_ms = inherent.control_ms - costs.links_us["control"] / US_PER_MS - _stages_ms(costs, SENT_TO_RECEIVED)
    state_ms = condition.video_ms if state_delay == "with_video" else 0.0
    video = injected("video", condition.video_ms, condition.video, seed)
    control = injected("control", condition.control_ms, condition.control, seed)
    return NetworkDelays(
        DelayModel(max(0.0, video_ms) + (condition.video_ms if video is None else 0.0), jitter, seed, "video inherent"),
        DelayModel(max(0.0, control_ms) + (condition.control_ms if control is None else 0.0)),
        DelayModel(max(0.0, control_ms) + state_ms),
        DelayModel(0.0),
        video,
        control,
    )


def virtual_network(requested: NetworkDelays, costs: Costs) -> NetworkDelays:
    """Add what a real loopback has by itself, as measured."""
    return replace(
        requested,
        video=_later(requested.video, costs.links_us["video"]),
        control=_later(requested.control, costs.links_us["control"]),
        state=_later(requested.state, costs.links_us["state"]),
        unheld=_later(requested.unheld, costs.links_us["state"]),
    )


def _later(law: DelayModel, by_us: float) -> DelayModel:
    return DelayModel(law.constant_ms + by_us / US_PER_MS, law.jitter, law.seed, law.name)


def _stages_ms(costs: Costs, stages: tuple[tuple[str, str], ...]) -> float:
    return sum(costs.stages_us.get(node, {}).get(stage, 0.0) for node, stage in stages) / US_PER_MS
