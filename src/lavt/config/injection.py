"""The schema of network conditions, and of their injection on two machines."""

from __future__ import annotations

from typing import Any, Final, Literal

from pydantic import Field

from lavt.config.section import Section
from lavt.transport.emulation.impairment import QUEUE_PACKETS

MAX_UNDELAYED_SHARE: Final = {"video": 0.0, "control": 0.5}
"""For each flow, the largest share of undelayed packets with which at least half of the flow is still delayed. For
video the share is 0, because a single undelayed repair packet can complete its frame early."""


class InjectionConfig(Section):
    """How a side on its own machine injects latency into the packets it sends, by `tc netem`; requires root."""

    interface: str = ""
    """The interface towards the other machine; empty: this machine injects nothing."""
    control_protocol: Literal["udp", "tcp"] = "udp"
    """The protocol of the link between the routers."""
    control_port: int = Field(7448, ge=1, le=65535)
    """The port of the vehicle's router."""


class ServerInjectionConfig(InjectionConfig):
    """The server's injection, which a client can request."""

    remote: bool = False
    """Whether a client may request injection: with a simulated vehicle at any time, otherwise while the vehicle is
    stationary and disarmed."""


class ClientInjectionConfig(InjectionConfig):
    """The client's injection: the condition under which it drives."""

    condition: str = ""
    """A condition of `netem/conditions.yaml`; empty: no injection."""
    state_delay: Literal["none", "with_video"] = "none"
    """with_video: the vehicle's state is delayed by the video's constant delay, too."""


class ImpairmentConfig(Section):
    """The impairments of a flow in addition to a constant delay; see `docs/network.md`."""

    jitter_ms: float = Field(0.0, ge=0, le=10_000)
    """The standard deviation of the delay; for the uniform distribution, half of its width."""
    jitter_correlation: float = Field(0.0, ge=0, lt=1)
    """The correlation of the delay with the delay 20 ms earlier."""
    jitter_distribution: Literal["normal", "uniform", "pareto", "paretonormal"] = "normal"
    """The distribution of the delay: normal, pareto and paretonormal by the tables of tc, or uniform."""
    loss: float = Field(0.0, ge=0, lt=1)
    """The share of packets that are lost."""
    loss_burst_packets: float = Field(0.0, ge=0, le=10_000)
    """The mean length of a burst of lost packets; 0 or 1: independent losses."""
    rate_bps: int = Field(0, ge=0, le=10_000_000_000)
    """0: no limit."""
    reorder: float = Field(0.0, ge=0, lt=1)
    """The share of packets that are not delayed, so that they overtake delayed packets."""
    trace: str = ""
    """A file of `netem/traces`, or a path: the delay over time (a name that ends in .csv), or the capacity over time in
    Mahimahi's format (any other name)."""
    queue_packets: int = Field(QUEUE_PACKETS, ge=1, le=1_000_000)
    """The length of the queue before a limit by `rate_bps` or a capacity trace; further packets are dropped."""

    @property
    def has_delay_trace(self) -> bool:
        """Whether the delay follows a trace."""
        return self.trace.endswith(".csv")


class LinkConfig(ImpairmentConfig):
    """The delay and the impairments of one direction of a relayed flow."""

    delay_ms: float = Field(0.0, ge=0, le=60_000)
    """The constant delay."""


class FlowChanges(Section):
    """The values with which a run replaces those of its condition in one direction; null: the condition's value."""

    delay_ms: float | None = Field(None, ge=0, le=60_000)
    """The constant delay."""
    jitter_ms: float | None = Field(None, ge=0, le=10_000)
    """The standard deviation of the delay."""
    jitter_correlation: float | None = Field(None, ge=0, lt=1)
    """The correlation of the delay with the delay 20 ms earlier."""
    jitter_distribution: Literal["normal", "uniform", "pareto", "paretonormal"] | None = None
    """The distribution of the delay: normal, pareto and paretonormal by the tables of tc, or uniform."""
    loss: float | None = Field(None, ge=0, lt=1)
    """The share of packets that are lost."""
    loss_burst_packets: float | None = Field(None, ge=0, le=10_000)
    """The mean length of a burst of lost packets."""
    rate_bps: int | None = Field(None, ge=0, le=10_000_000_000)
    """The rate limit; 0: none."""
    reorder: float | None = Field(None, ge=0, lt=1)
    """The share of packets that are not delayed."""
    trace: str | None = None
    """A trace of the delay or of the capacity."""
    queue_packets: int | None = Field(None, ge=1, le=1_000_000)
    """The length of the queue before a rate limit."""

    @property
    def replacements(self) -> dict[str, Any]:
        """The values that replace those of the condition, by name."""
        return self.model_dump(exclude_none=True)

    def apply_to(self, delay_ms: float, impairment: ImpairmentConfig) -> tuple[float, ImpairmentConfig]:
        """Return the changed delay and impairment."""
        replacements = self.replacements
        delay_ms = replacements.pop("delay_ms", delay_ms)
        return delay_ms, ImpairmentConfig(**{**impairment.model_dump(), **replacements})


class Condition(Section):
    """A network condition: the delay and impairments of both flows."""

    video_ms: float = Field(ge=0, le=60_000)
    """The constant delay of the video."""
    control_ms: float = Field(ge=0, le=60_000)
    """The constant delay of the commands."""
    video: ImpairmentConfig = ImpairmentConfig()
    control: ImpairmentConfig = ImpairmentConfig()

    @property
    def flows(self) -> dict[str, tuple[float, ImpairmentConfig]]:
        """The delay and the impairment of each flow."""
        return {"video": (self.video_ms, self.video), "control": (self.control_ms, self.control)}

    @property
    def constant_ms(self) -> dict[str, float | None]:
        """The delay of each flow; None if it follows a trace."""
        flows = self.flows.items()
        return {name: None if impairment.has_delay_trace else delay_ms for name, (delay_ms, impairment) in flows}

    @property
    def least_ms(self) -> dict[str, float]:
        """A lower bound of each flow's median delay: jitter and reordering can lower the median.

        The bound is 0 if the reordered share exceeds `MAX_UNDELAYED_SHARE`, otherwise the delay minus four standard
        deviations of the jitter.
        """
        return {
            name: 0.0
            if impairment.reorder > MAX_UNDELAYED_SHARE[name]
            else max(0.0, delay_ms - 4 * impairment.jitter_ms)
            for name, (delay_ms, impairment) in self.flows.items()
        }
