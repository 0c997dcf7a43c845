"""The schema of the config of `lavt relay`."""

from __future__ import annotations

from pydantic import Field

from lavt.config.injection import LinkConfig
from lavt.config.section import Section


class DelayConfig(Section):
    """One direction of a relayed flow: a constant delay, a lognormal jitter, and the impairments of a condition."""

    constant_ms: float = Field(0.0, ge=0, le=70_000)
    """The sum of the constant delays of the inherent latency and of the condition."""
    jitter_median_ms: float = Field(0.0, ge=0, le=60_000)
    """The median of the lognormal jitter, which is added to the constant delay; 0: no jitter."""
    jitter_sigma: float = Field(0.0, ge=0, le=3)
    """The standard deviation of the jitter's logarithm."""
    link: LinkConfig = LinkConfig()


class RelayConfig(Section):
    """The relay: its own addresses, the server's addresses, and the delays."""

    video_listen: str = "127.0.0.1:0"
    """The relay's UDP address for video, which the client dials, as host:port; port 0: any free port."""
    video_server: str
    """The server's UDP address for video, as host:port."""
    control_listen: str = "127.0.0.1:0"
    """The relay's UDP address for commands and state, which the client's router dials."""
    control_server: str
    """The UDP address of the server's router."""
    video: DelayConfig = DelayConfig()
    control: DelayConfig = DelayConfig()
    state: DelayConfig = DelayConfig()
    seed: int = Field(1, ge=0, lt=2**63)
    """The seed of all random delays and losses."""
