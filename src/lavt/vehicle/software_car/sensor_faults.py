"""Faults of a software car's speed reports: stuck, scaled or not sent."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

MAX_REPORTED_MPS: Final = 90.0
"""The largest speed that all sources can report."""

SPEED_SOURCES: Final = ("speed", "second_speed", "wheel_speed")
"""The speeds that a kit reports; generation 1 has no second speed."""


@dataclass(slots=True)
class SensorFaults:
    """Faults by source of speed, one of `SPEED_SOURCES`."""

    stuck_mps: dict[str, float] = field(default_factory=dict)
    """The speeds that sources report all the time."""
    factors: dict[str, float] = field(default_factory=dict)
    """The factors by which sources multiply the speed."""
    dropped: set[str] = field(default_factory=set)
    """Sources whose message is not sent."""

    def reported_mps(self, source: str, speed_mps: float) -> float:
        """Return the speed that a source reports if the car's speed is `speed_mps`."""
        reported_mps = self.stuck_mps.get(source, speed_mps * self.factors.get(source, 1.0))
        return min(max(reported_mps, -MAX_REPORTED_MPS), MAX_REPORTED_MPS)

    def clear(self, source: str) -> None:
        """Remove a source's faults."""
        self.stuck_mps.pop(source, None)
        self.factors.pop(source, None)
        self.dropped.discard(source)
