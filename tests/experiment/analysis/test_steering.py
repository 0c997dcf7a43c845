from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import periodogram

from lavt.domain import NS_PER_MS, FloatArray
from lavt.experiment.analysis.steering import oscillation_hz, power_spectrum, steering, steering_rate_rms_radps
from lavt.recording.table import Table, table_of


def truth(steering_rad: list[float], *, step_ms: int = 100, step_m: float = 1.0) -> Table:
    rows: list[dict[str, Any]] = [
        {"mono_ns": index * step_ms * NS_PER_MS, "progress_m": index * step_m, "steering_rad": angle}
        for index, angle in enumerate(steering_rad)
    ]
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def swinging(hertz: float, amplitude_rad: float, *, seconds: float = 30.0) -> tuple[FloatArray, FloatArray]:
    at_s = np.arange(0, seconds, 0.017)
    return at_s, amplitude_rad * np.sin(2 * np.pi * hertz * at_s)


def test_the_rate_of_steering_is_weighted_by_time() -> None:
    """0.1 rad in 1 s and then nothing for 3 s is a root mean square of 0.05 rad/s; rows of one moment say nothing."""
    at_s, angle_rad = np.array([0.0, 1.0, 1.0, 4.0]), np.array([0.0, 0.1, 0.1, 0.1])
    assert steering_rate_rms_radps(at_s, angle_rad) == pytest.approx(0.05)
    assert steering_rate_rms_radps(at_s[:1], angle_rad[:1]) is None


def test_reversals_are_counted_by_time_and_by_distance() -> None:
    """Three turns back in 4 s and 40 m are 0.75 a second and 75 a kilometre."""
    angles = [0.0] * 36 + [0.1, -0.1, 0.1, -0.1, -0.1]
    entry = steering(truth(angles))
    assert entry["steering_reversals_per_s"] == pytest.approx(0.75)
    assert entry["steering_reversals_per_km"] == pytest.approx(75.0)


@pytest.mark.parametrize("hertz", [0.15, 0.4, 1.3])
def test_an_oscillation_is_found(hertz: float) -> None:
    """The frequency of a sine is found to 0.01 Hz in 30 s, though the steering drifts beside it."""
    at_s, angle_rad = swinging(hertz, 0.05)
    assert oscillation_hz(at_s, angle_rad + 0.05 * at_s) == pytest.approx(hertz, abs=0.01)


def test_the_spectrum_is_scipys() -> None:
    """Power over frequency is that of SciPy's periodogram with the same window, but at 0 Hz and the highest."""
    even_rad = np.random.default_rng(1).normal(size=311).cumsum()
    hertz, power = power_spectrum(even_rad)
    expected = periodogram(even_rad, 20.0, "hann", nfft=4096, detrend="linear", scaling="spectrum")
    assert hertz == pytest.approx(expected[0])
    assert power[1:-1] == pytest.approx(expected[1][1:-1])


def test_the_widest_of_two_oscillations_counts() -> None:
    """Of two swings at once the wider is dominant."""
    (at_s, slow_rad), (_, quick_rad) = swinging(0.3, 0.02), swinging(0.9, 0.06)
    assert oscillation_hz(at_s, slow_rad + quick_rad) == pytest.approx(0.9, abs=0.01)


def test_where_nothing_swings_there_is_no_oscillation() -> None:
    """A straight wheel, a bend, swings of less than 0.01 rad, fewer than three of them, and no rows have none."""
    at_s, small_rad = swinging(0.4, 0.004)
    assert oscillation_hz(at_s, np.zeros(len(at_s))) is None
    assert oscillation_hz(at_s, 0.05 * at_s) is None
    assert oscillation_hz(at_s, small_rad) is None
    assert oscillation_hz(*swinging(0.4, 0.006)) == pytest.approx(0.4, abs=0.01)
    assert oscillation_hz(*swinging(0.4, 0.05, seconds=5.0)) is None
    assert oscillation_hz(np.zeros(0), np.zeros(0)) is None


def test_without_truth_nothing_is_said_of_the_steering() -> None:
    """Every entry is null where nothing was recorded, and where the vehicle told no angle."""
    nothing = set(steering(truth([])).values())
    assert nothing == {None}
    assert set(steering(truth([float("nan")] * 3)).values()) == {None}
