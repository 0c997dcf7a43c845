"""Lane-keeping metrics: pure functions of the recorded ground truth. `docs/metrics.md` has the formulas."""

from __future__ import annotations

import numpy as np

from lavt.domain import FloatArray
from lavt.recording.table import Table

STEP_M = 0.25
"""The distance between two samples of an error. Errors are sampled by distance and not by time, so that phases in which
the car drives slowly or is stationary do not have a higher weight."""

MAX_DISTANCE_M = 50_000
"""A longer progress cannot be one drive, and would take minutes to evaluate."""

PARTIAL_STEP_M = 10
"""The result has the error between the start and each multiple of this distance, to compare runs that ended early."""


def sampled_by_distance(truth: Table, name: str) -> FloatArray:
    """Return column `name` at every `STEP_M` of new progress along the route, interpolated linearly.

    If the car passed a position several times, the first passage is used.
    """
    progress_m = truth.floats("progress_m")
    values = truth.floats(name)
    known = np.isfinite(progress_m) & np.isfinite(values)
    progress_m, values = progress_m[known], values[known]
    if len(progress_m) == 0:
        return np.zeros(0)
    farthest_m = np.maximum.accumulate(progress_m)
    is_new_progress = np.concatenate([[True], progress_m[1:] > farthest_m[:-1]])
    if farthest_m[-1] - progress_m[0] > MAX_DISTANCE_M:
        raise ValueError(f"a drive of more than {MAX_DISTANCE_M / 1000:g} km")
    positions_m = np.arange(progress_m[0], farthest_m[-1] + 1e-9, STEP_M)
    return np.asarray(np.interp(positions_m, progress_m[is_new_progress], values[is_new_progress]), np.float64)


def cross_track_metrics(truth: Table) -> dict[str, float | None]:
    """Return mean, RMS, 95th percentile and maximum of the distance from the lane's centre, in metres."""
    return absolute_error_metrics(np.abs(sampled_by_distance(truth, "cross_track_m")))


def absolute_error_metrics(error_m: FloatArray) -> dict[str, float | None]:
    """Return mean, RMS, 95th percentile and maximum of absolute errors in metres; None without errors."""
    if len(error_m) == 0:
        return {"mae_m": None, "rms_m": None, "p95_m": None, "max_m": None}
    return {
        "mae_m": float(error_m.mean()),
        "rms_m": root_mean_square(error_m),
        "p95_m": float(np.percentile(error_m, 95)),
        "max_m": float(error_m.max()),
    }


def p95_by_10m(truth: Table) -> list[float]:
    """Return the 95th percentile of the distance from the lane's centre up to each multiple of 10 m of progress.

    Entry i covers the first 10 m x (i + 1) of the drive. The list is empty if the drive is shorter than 10 m.
    """
    error_m = np.abs(sampled_by_distance(truth, "cross_track_m"))
    samples = round(PARTIAL_STEP_M / STEP_M)
    return [float(np.percentile(error_m[: end + 1], 95)) for end in range(samples, len(error_m), samples)]


def heading_metrics(truth: Table) -> dict[str, float | None]:
    """Return mean, RMS and 95th percentile of the angle between the car and the lane, in radians."""
    error_rad = np.abs(sampled_by_distance(truth, "heading_error_rad"))
    return {
        "heading_mae_rad": float(error_rad.mean()) if len(error_rad) else None,
        "heading_rms_rad": root_mean_square(error_rad),
        "heading_p95_rad": float(np.percentile(error_rad, 95)) if len(error_rad) else None,
    }


def root_mean_square(values: FloatArray) -> float | None:
    """Return the root mean square; None without values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def distance_m(truth: Table) -> float | None:
    """Return the progress along the route from the first to the farthest row; None without rows."""
    progress_m = truth.floats("progress_m")
    progress_m = progress_m[np.isfinite(progress_m)]
    return float(progress_m.max() - progress_m[0]) if len(progress_m) else None


def per_km(count: int, driven_m: float | None) -> float | None:
    """Return a count per kilometre driven; None if no distance was driven."""
    return count / (driven_m / 1000) if driven_m else None


def route_length_m(route: Table) -> float | None:
    """Return the recorded distance from the route's start to its goal; None if it was not recorded."""
    lengths_m = route.floats("length_m")
    return float(lengths_m[0]) if len(lengths_m) and np.isfinite(lengths_m[0]) else None
