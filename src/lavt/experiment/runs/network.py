"""The network delays of a run: the inherent latency, and the injected delay or impairment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lavt.assembly.links import link_injection
from lavt.config import Condition, Costs
from lavt.domain import NS_PER_US
from lavt.runtime.virtual import RTP_TICKS_PER_DRAW
from lavt.streams import QuantileStream
from lavt.transport.emulation.delay_line import DelayModel, Lognormal
from lavt.transport.emulation.link import LinkInjection

US_PER_MS = 1000.0

VIDEO_LATENCY_STAGES = (
    ("camera", "stamp"),
    ("camera", "encode"),
    ("camera", "packetize"),
    ("driver", "wait_access_unit"),
    ("driver", "decode"),
    ("driver", "read_stamp"),
)
"""The stages that are part of tau_v. A network profile gives the complete tau_v (the inherent latency), so the delay of
its network is tau_v minus the times of these stages."""
CONTROL_LATENCY_STAGES = (("driver", "command"),)
"""The stages that are part of tau_c."""


@dataclass(frozen=True, slots=True)
class BaselineLatency:
    """The complete tau_v and tau_c of a network profile, without injection.

    `video_ms` is the constant part of tau_v, to which `video_jitter` adds a random part.
    """

    video_ms: float
    video_jitter: Lognormal
    control_ms: float


INHERENT = {
    # The paper's WiFi 5: tau_v with median 62 and 95th percentile 86 ms, tau_c of 8 to 10 ms.
    "paper_wifi5": BaselineLatency(video_ms=50.0, video_jitter=Lognormal(median_ms=12.0, sigma=0.668), control_ms=9.0),
}


@dataclass(frozen=True, slots=True)
class NetworkDelays:
    """The delays of video, state (server to client), control (client to server), and traffic without injected delay.

    `state` includes the delay injected into the state. If only a constant delay is injected into the video, `video`
    includes it; any other injection into the video, with its constant part, is in `video_injected` instead. The same
    holds for `control` and `control_injected`.
    """

    video: DelayModel
    control: DelayModel
    state: DelayModel
    without_injection: DelayModel
    video_injected: LinkInjection | None = None
    control_injected: LinkInjection | None = None


def injected_network(profile: str, condition: Condition, costs: Costs, seed: int, *, state_delay: str) -> NetworkDelays:
    """Return the delays to inject on a loopback interface: the inherent latency of `profile`, and `condition`.

    The profile "loopback" has no delay. Raises `UserError` for a contradictory condition, and for a trace that is
    missing or invalid.
    """
    inherent = INHERENT.get(profile)
    video_ms, jitter, control_ms = 0.0, None, 0.0
    if inherent is not None:
        video_ms = inherent.video_ms - costs.links_us["video"] / US_PER_MS - _stages_ms(costs, VIDEO_LATENCY_STAGES)
        jitter = inherent.video_jitter
        control_ms = (
            inherent.control_ms - costs.links_us["control"] / US_PER_MS - _stages_ms(costs, CONTROL_LATENCY_STAGES)
        )
    state_ms = condition.video_ms if state_delay == "with_video" else 0.0
    video_injected = link_injection("video", condition.video_ms, condition.video, seed)
    control_injected = link_injection("control", condition.control_ms, condition.control, seed)
    constant_video_ms = max(0.0, video_ms) + (condition.video_ms if video_injected is None else 0.0)
    constant_control_ms = max(0.0, control_ms) + (condition.control_ms if control_injected is None else 0.0)
    return NetworkDelays(
        video=DelayModel(constant_video_ms, jitter, seed, name="video inherent"),
        control=DelayModel(constant_control_ms),
        state=DelayModel(max(0.0, control_ms) + state_ms),
        without_injection=DelayModel(0.0),
        video_injected=video_injected,
        control_injected=control_injected,
    )


def virtual_delay(requested: DelayModel, costs: Costs, link: str, seed: int, channel: str) -> DelayModel:
    """Return the requested delay plus the measured latency of `link`, a key of the costs, on a real loopback interface.

    If the costs have quantiles, the latency is drawn, and each channel has a random-number stream of its own. The
    packets of a video frame share one draw.
    """
    quantiles_us = costs.link_quantiles_us.get(link)
    if quantiles_us is None:
        return replace(requested, constant_ms=requested.constant_ms + costs.links_us[link] / US_PER_MS)
    return replace(
        requested,
        measured_ns=QuantileStream(seed, f"cost of link {channel}", costs.levels, in_ns(quantiles_us)),
        indices_per_draw=RTP_TICKS_PER_DRAW if channel == "rtp" else 1,
    )


def in_ns(values_us: Sequence[float]) -> list[float]:
    """Convert microseconds to nanoseconds."""
    return [value_us * NS_PER_US for value_us in values_us]


def _stages_ms(costs: Costs, stages: tuple[tuple[str, str], ...]) -> float:
    return sum(costs.stages_us.get(node, {}).get(stage, 0.0) for node, stage in stages) / US_PER_MS
