"""TEMPORARY."""

from __future__ import annotations

from typing import Literal

from lavt.value import value

Protocol = Literal["udp", "tcp"]
Distribution = Literal["uniform", "normal", "pareto", "paretonormal"]


@value
class Law:
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    jitter_correlation: float = 0.0
    jitter_distribution: Distribution = "normal"
    loss: float = 0.0
    loss_burst_packets: float = 0.0
    rate_bps: int = 0
    reorder: float = 0.0


@value
class Flow:
    name: Literal["video", "control", "state"]
    protocol: Protocol
    port: int
    end: Literal["source", "destination"]
    law: Law
