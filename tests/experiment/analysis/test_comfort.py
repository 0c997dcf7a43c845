from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.comfort import comfort_metrics, lateral_jerk_rms_mps3
from lavt.recording.table import Table, table_of

SPEED_MPS = 8.0


def truth(heading_rad: list[float], *, step_ms: int = 4) -> Table:
    rows: list[dict[str, Any]] = [
        {"mono_ns": index * step_ms * NS_PER_MS, "heading_rad": heading, "speed_mps": SPEED_MPS}
        for index, heading in enumerate(heading_rad)
    ]
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def test_the_jerk_of_a_weaving_car() -> None:
    """A heading of a sin(wt) has the jerk a w^2 v / sqrt(2), also where the heading passes half a turn."""
    amplitude_rad, omega_radps = 0.02, 2.0
    times_s = np.arange(0, 8 * math.pi, 0.004)
    expected = amplitude_rad * omega_radps**2 * SPEED_MPS / math.sqrt(2)
    for middle_rad in (0.0, math.pi):
        heading_rad = middle_rad + amplitude_rad * np.sin(omega_radps * times_s)
        wrapped_rad = [math.remainder(heading, 2 * math.pi) for heading in heading_rad.tolist()]
        assert lateral_jerk_rms_mps3(truth(wrapped_rad)) == pytest.approx(expected, rel=0.02)


def test_a_steady_bend_has_no_jerk() -> None:
    """A constant yaw rate is lateral acceleration without jerk."""
    assert comfort_metrics(truth((0.001 * np.arange(500)).tolist()))["lateral_jerk_rms_mps3"] == pytest.approx(
        0.0, abs=1e-6
    )


def test_the_jerk_of_too_little_is_unknown() -> None:
    """A drive of less than 0.2 s, or without known motion, has no jerk, and one of years is an error."""
    assert lateral_jerk_rms_mps3(truth([])) is None
    assert lateral_jerk_rms_mps3(truth([0.1] * 40)) is None
    assert lateral_jerk_rms_mps3(truth([math.nan] * 500)) is None
    with pytest.raises(ValueError, match="24 hours"):
        lateral_jerk_rms_mps3(truth([0.0, 0.1], step_ms=10**8))
