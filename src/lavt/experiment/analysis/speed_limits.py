"""How the vehicle's speed was limited during a drive: by which reason, for how long, and how much."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavt.domain import NS_PER_S
from lavt.recording.table import Table
from lavt.safety.speed_limit import SPEED_LIMIT_REASONS

LONGEST_SAMPLE_NS = NS_PER_S // 10
"""A sample of the limit is valid until the next one, at most for this time; the vehicle makes 50 a second."""


def speed_limit_metrics(samples: Table, began_ns: int, ended_ns: int) -> dict[str, Any] | None:
    """Return the value of `speed_limits`, as `docs/metrics.md` defines it; None for a drive without a sample.

    `samples` is the channel `speed_limit`, and the drive lasts from `began_ns` to `ended_ns`.
    """
    at_ns = samples.ints("mono_ns")
    samples = samples.where((at_ns >= began_ns) & (at_ns <= ended_ns))
    if not len(samples):
        return None
    at_ns = samples.ints("mono_ns")
    durations_s = np.minimum(np.diff(at_ns, append=ended_ns), LONGEST_SAMPLE_NS) / NS_PER_S
    limits_mps, reasons = samples.floats("limit_mps"), np.array(samples.texts("reason"))
    total_s = float(durations_s.sum())
    times_s = {name: float(durations_s[reasons == name].sum()) for name in SPEED_LIMIT_REASONS if name in reasons}
    return {
        "time_s": total_s,
        "lowest_mps": float(limits_mps.min()),
        "mean_mps": float((limits_mps * durations_s).sum()) / total_s if total_s else None,
        "reasons": {
            name: {"time_s": time_s, "share": time_s / total_s if total_s else None} for name, time_s in times_s.items()
        },
    }
