"""How well the lane was kept: pure functions of the recorded ground truth. `docs/metrics.md` has the formulas."""

from __future__ import annotations

import numpy as np

from lavt.domain import NS_PER_S, FloatArray
from lavt.experiment.table import Table

STEP_M = 0.25
"""Errors are sampled by distance, so that a car that creeps or waits does not count more than one that drives."""

REVERSAL_DEADBAND_RAD = 0.01
"""Smallest turn back of the road wheels that counts as a steering reversal (0.57 degrees)."""


def sampled_by_distance(truth: Table, name: str) -> FloatArray:
    """Column `name` every `STEP_M` of new progress along the route, interpolated linearly.

    Where the car went back, the first passage counts.
    """
    progress_m = truth.floats("progress_m")
    values = truth.floats(name)
    known = np.isfinite(progress_m) & np.isfinite(values)
    progress_m, values = progress_m[known], values[known]
    if len(progress_m) == 0:
        return np.zeros(0)
    farthest_m = np.maximum.accumulate(progress_m)
    new = np.concatenate([[True], progress_m[1:] > farthest_m[:-1]])
    places_m = np.arange(progress_m[0], farthest_m[-1] + 1e-9, STEP_M)
    return np.asarray(np.interp(places_m, progress_m[new], values[new]), np.float64)


def cross_track(truth: Table) -> dict[str, float | None]:
    """Mean, root mean square, 95th percentile and maximum of the distance from the lane's centre, in metres."""
    error_m = np.abs(sampled_by_distance(truth, "cross_track_m"))
    if len(error_m) == 0:
        return {"mae_m": None, "rms_m": None, "p95_m": None, "max_m": None}
    return {
        "mae_m": float(error_m.mean()),
        "rms_m": root_mean_square(error_m),
        "p95_m": float(np.percentile(error_m, 95)),
        "max_m": float(error_m.max()),
    }


def root_mean_square(values: FloatArray) -> float | None:
    """Root of the mean square; None of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def distance_m(truth: Table) -> float | None:
    """Progress along the route from the first to the farthest row."""
    progress_m = truth.floats("progress_m")
    progress_m = progress_m[np.isfinite(progress_m)]
    return float(progress_m.max() - progress_m[0]) if len(progress_m) else None


def steering_reversals(steering_rad: FloatArray) -> int:
    """How often the steering turned back by more than `REVERSAL_DEADBAND_RAD` from its last extreme."""
    count, direction = 0, 0
    extreme = lowest = highest = steering_rad[0] if len(steering_rad) else 0.0
    for angle in steering_rad.tolist():
        if direction == 0:  # not yet known: the first turn sets it and is no reversal
            lowest, highest = min(lowest, angle), max(highest, angle)
            if highest - lowest > REVERSAL_DEADBAND_RAD:
                direction, extreme = (1 if angle == highest else -1), angle
        elif (angle - extreme) * direction > 0:
            extreme = angle
        elif (extreme - angle) * direction > REVERSAL_DEADBAND_RAD:
            count, direction, extreme = count + 1, -direction, angle
    return count


def reversals_per_s(truth: Table) -> float | None:
    """Steering reversals per second of the recorded truth."""
    mono_ns = truth.ints("mono_ns")
    if len(mono_ns) < 2 or mono_ns[-1] <= mono_ns[0]:
        return None
    return steering_reversals(truth.floats("steering_rad")) / (float(mono_ns[-1] - mono_ns[0]) / NS_PER_S)
