"""The speed limits of a vehicle, and the one table of their reasons."""

from __future__ import annotations

from typing import Final, NamedTuple

from lavt.domain import SpeedLimitReason

SPEED_LIMIT_REASONS: Final[dict[SpeedLimitReason, str]] = {
    "speed": "The highest speed of the vehicle, `safety.speed_limit_mps`.",
    "stopping distance": "Faster, the vehicle could not stop on the path of its last command if no other command "
    "followed.",
    "sight": "Faster, the vehicle could not stop within the sight distance if an obstacle appeared after the last "
    "picture.",
    "latency": "The picture age is above `latency_limit_ms`. Faster, the vehicle would drive a longer way blind than "
    "at the nominal speed with this limit.",
    "delay margin": "The quantile of the picture ages is above the delay that the driver or controller tolerates at "
    "the next higher speed.",
    "no picture": "No command was accepted yet whose picture has a known age.",
    "recovery": "The limit was lower, and rises slowly.",
}
"""The meaning of each reason. Of equal limits, the one whose reason comes first is reported."""


class SpeedLimit(NamedTuple):
    """A limit of the speed, forward or backward, and its reason."""

    mps: float
    reason: SpeedLimitReason


def lowest(*limits: SpeedLimit) -> SpeedLimit:
    """Return the lowest limit; of equal ones, the one whose reason comes first in `SPEED_LIMIT_REASONS`."""
    order = list(SPEED_LIMIT_REASONS)
    return min(limits, key=lambda limit: (limit.mps, order.index(limit.reason)))
