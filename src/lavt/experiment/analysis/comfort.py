"""Ride comfort: a pure function of the recorded ground truth. `docs/metrics.md` has the formula."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from lavt.domain import NS_PER_S
from lavt.experiment.analysis.steering import MAX_DURATION_S
from lavt.experiment.analysis.tracking import root_mean_square
from lavt.recording.table import Table

STEP_S: Final = 0.1
"""The time between two samples of the motion. A person feels slower changes of the acceleration."""
FEWEST_SAMPLES: Final = 3


def comfort_metrics(truth: Table) -> dict[str, Any]:
    """Return the RMS of the lateral jerk: of the change of the lateral acceleration, which is speed x yaw rate."""
    return {"lateral_jerk_rms_mps3": lateral_jerk_rms_mps3(truth)}


def lateral_jerk_rms_mps3(truth: Table) -> float | None:
    """Return the RMS of the lateral jerk over the drive; None if it is too short or the motion is unknown.

    Raises `ValueError` if the rows span more time than a drive can.
    """
    mono_ns, heading_rad, speed_mps = truth.ints("mono_ns"), truth.floats("heading_rad"), truth.floats("speed_mps")
    known = np.isfinite(heading_rad) & np.isfinite(speed_mps)
    if not known.any():
        return None
    times_s = (mono_ns[known] - mono_ns[known][0]) / NS_PER_S
    if times_s[-1] > MAX_DURATION_S:
        raise ValueError(f"a drive of more than {MAX_DURATION_S // 3600} hours")
    at_s = np.arange(0.0, times_s[-1], STEP_S)
    if len(at_s) < FEWEST_SAMPLES:
        return None
    heading_at_rad = np.interp(at_s, times_s, np.unwrap(heading_rad[known]))
    lateral_mps2 = np.interp(at_s, times_s, speed_mps[known])[1:] * np.diff(heading_at_rad) / STEP_S
    return root_mean_square(np.asarray(np.diff(lateral_mps2) / STEP_S, np.float64))
