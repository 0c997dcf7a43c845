"""What is injected under a condition, and how two machines have it done."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from lavt.config.section import Section


class InjectionConfig(Section):
    """How a side of two machines injects delay by `tc netem` into what its machine sends; it takes root."""

    interface: str = ""
    """The one towards the other machine; empty: this machine delays nothing."""
    control_protocol: Literal["udp", "tcp"] = "udp"
    """Of the link between the routers, and the port at which the vehicle's router listens."""
    control_port: int = Field(7448, ge=1, le=65535)


class ServerInjectionConfig(InjectionConfig):
    """The server's: what it sends is delayed when a client asks for it."""

    remote: bool = False
    """Whether a client may: for a simulated vehicle at any time, for another one while it stands disarmed."""


class ClientInjectionConfig(InjectionConfig):
    """The client's: which condition it drives under."""

    condition: str = ""
    """Of `netem/conditions.yaml`; empty: the network is taken as it is."""
    state_delay: Literal["none", "with_video"] = "none"


class Impairment(Section):
    """What the network does to a flow beside a constant delay; see `docs/netem.md`."""

    jitter_ms: float = Field(0.0, ge=0, le=10_000)
    """Standard deviation of the delay; of a uniform law the half width."""
    jitter_correlation: float = Field(0.0, ge=0, lt=1)
    """Of the delay with itself 20 ms before."""
    jitter_distribution: Literal["normal", "uniform", "pareto", "paretonormal"] = "normal"
    loss: float = Field(0.0, ge=0, lt=1)
    loss_burst_packets: float = Field(0.0, ge=0, le=10_000)
    """Mean length of a burst of lost packets; 0 or 1: each is lost by itself."""
    rate_bps: int = Field(0, ge=0, le=10_000_000_000)
    """0: no limit."""
    reorder: float = Field(0.0, ge=0, lt=1)
    """Share of packets that are not delayed, and so overtake."""


class FlowChanges(Section):
    """What a run changes of its condition in one direction; where nothing is given, it is as the condition says."""

    delay_ms: float | None = Field(None, ge=0, le=60_000)
    jitter_ms: float | None = Field(None, ge=0, le=10_000)
    jitter_correlation: float | None = Field(None, ge=0, lt=1)
    jitter_distribution: Literal["normal", "uniform", "pareto", "paretonormal"] | None = None
    loss: float | None = Field(None, ge=0, lt=1)
    loss_burst_packets: float | None = Field(None, ge=0, le=10_000)
    rate_bps: int | None = Field(None, ge=0, le=10_000_000_000)
    reorder: float | None = Field(None, ge=0, lt=1)

    @property
    def given(self) -> dict[str, Any]:
        """What differs from the condition."""
        return self.model_dump(exclude_none=True)

    def of(self, delay_ms: float, impairment: Impairment) -> tuple[float, Impairment]:
        """Give delay and impairment as changed."""
        given = self.given
        delay_ms = given.pop("delay_ms", delay_ms)
        return delay_ms, Impairment(**{**impairment.model_dump(), **given})


class Condition(Section):
    """What is injected under a condition."""

    video_ms: float = Field(ge=0, le=60_000)
    control_ms: float = Field(ge=0, le=60_000)
    video: Impairment = Impairment()
    control: Impairment = Impairment()

    @property
    def is_delay_only(self) -> bool:
        """Whether nothing but a constant delay is injected."""
        return self.video == self.control == Impairment()
