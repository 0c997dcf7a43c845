"""What is injected under a condition, and how two machines have it done."""

from __future__ import annotations

from typing import Any, Final, Literal

from pydantic import Field

from lavt.config.section import Section
from lavt.transport.emulation.link import QUEUE_PACKETS

EARLY_SHARE: Final = {"video": 0.0, "control": 0.5}
"""With more packets that overtake, the median need not be delayed: a repair packet brings its frame early."""


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


class ImpairmentConfig(Section):
    """What the network does to a flow beside a constant delay; see `docs/network.md`."""

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
    trace: str = ""
    """A delay (a name that ends in .csv) or a capacity (Mahimahi) over time: one of `netem/traces`, or a path."""
    queue_packets: int = Field(QUEUE_PACKETS, ge=1, le=1_000_000)
    """So many wait for `rate_bps` or a capacity; what comes then is dropped."""

    @property
    def has_delay_trace(self) -> bool:
        """Whether the delay changes by a trace."""
        return self.trace.endswith(".csv")


class LinkConfig(ImpairmentConfig):
    """What is injected into one direction of a relayed flow, as a condition has it."""

    delay_ms: float = Field(0.0, ge=0, le=60_000)


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
    trace: str | None = None
    queue_packets: int | None = Field(None, ge=1, le=1_000_000)

    @property
    def given(self) -> dict[str, Any]:
        """What is asked for instead of what the condition says."""
        return self.model_dump(exclude_none=True)

    def of(self, delay_ms: float, impairment: ImpairmentConfig) -> tuple[float, ImpairmentConfig]:
        """Give delay and impairment as changed."""
        given = self.given
        delay_ms = given.pop("delay_ms", delay_ms)
        return delay_ms, ImpairmentConfig(**{**impairment.model_dump(), **given})


class Condition(Section):
    """What is injected under a condition."""

    video_ms: float = Field(ge=0, le=60_000)
    control_ms: float = Field(ge=0, le=60_000)
    video: ImpairmentConfig = ImpairmentConfig()
    control: ImpairmentConfig = ImpairmentConfig()

    @property
    def flows(self) -> dict[str, tuple[float, ImpairmentConfig]]:
        """The delay of each flow, and what else happens to it."""
        return {"video": (self.video_ms, self.video), "control": (self.control_ms, self.control)}

    @property
    def constant_ms(self) -> dict[str, float | None]:
        """The delay of each flow; None where it changes by a trace."""
        return {name: None if each.has_delay_trace else delay_ms for name, (delay_ms, each) in self.flows.items()}

    @property
    def least_ms(self) -> dict[str, float]:
        """A delay that next to no median of each flow is below: jitter and overtaking make it less than was asked."""
        return {
            name: 0.0 if each.reorder > EARLY_SHARE[name] else max(0.0, delay_ms - 4 * each.jitter_ms)
            for name, (delay_ms, each) in self.flows.items()
        }
