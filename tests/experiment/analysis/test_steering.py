from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest

from lavt.domain import NS_PER_MS, FloatArray
from lavt.experiment.analysis.steering import oscillation_hz, power_spectrum, steering_metrics, steering_rate_rms_radps
from lavt.recording.table import Table, table_of


def truth(steering_rad: list[float], *, step_ms: int = 100, step_m: float = 1.0) -> Table:
    rows: list[dict[str, Any]] = [
        {"mono_ns": index * step_ms * NS_PER_MS, "progress_m": index * step_m, "steering_rad": angle}
        for index, angle in enumerate(steering_rad)
    ]
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def sine(hertz: float, amplitude_rad: float, *, seconds: float = 30.0) -> tuple[FloatArray, FloatArray]:
    times_s = np.arange(0, seconds, 0.017)
    return times_s, amplitude_rad * np.sin(2 * np.pi * hertz * times_s)


def test_the_steering_rate_is_weighted_by_time() -> None:
    """A change of 0.1 rad in 1 s, then none for 3 s, is an RMS of 0.05 rad/s; rows with equal times have no weight."""
    times_s, angle_rad = np.array([0.0, 1.0, 1.0, 4.0]), np.array([0.0, 0.1, 0.1, 0.1])
    assert steering_rate_rms_radps(times_s, angle_rad) == pytest.approx(0.05)
    assert steering_rate_rms_radps(times_s[:1], angle_rad[:1]) is None


def test_reversals_are_counted_by_time_and_by_distance() -> None:
    """Three reversals in 4 s and 40 m are 0.75 per second and 75 per kilometre."""
    angles = [0.0] * 36 + [0.1, -0.1, 0.1, -0.1, -0.1]
    entry = steering_metrics(truth(angles))
    assert entry["steering_reversals_per_s"] == pytest.approx(0.75)
    assert entry["steering_reversals_per_km"] == pytest.approx(75.0)


@pytest.mark.parametrize("hertz", [0.15, 0.4, 1.3])
def test_an_oscillation_is_found(hertz: float) -> None:
    """The frequency of a sine of 30 s is found within 0.01 Hz, although the steering angle drifts."""
    times_s, angle_rad = sine(hertz, 0.05)
    assert oscillation_hz(times_s, angle_rad + 0.05 * times_s) == pytest.approx(hertz, abs=0.01)


def test_the_spectrum_equals_scipys() -> None:
    """The spectrum equals SciPy's periodogram with the same window, except at 0 Hz and the highest frequency."""
    angles_rad = np.random.default_rng(1).normal(size=311).cumsum()
    hertz, power = power_spectrum(angles_rad)
    periodogram = importlib.import_module("scipy.signal").periodogram  # the import takes a second of each worker
    expected_hertz, expected_power = periodogram(
        angles_rad, 20.0, "hann", nfft=4096, detrend="linear", scaling="spectrum"
    )
    assert hertz == pytest.approx(expected_hertz)
    assert power[1:-1] == pytest.approx(expected_power[1:-1])


def test_the_larger_of_two_oscillations_counts() -> None:
    """The larger of two simultaneous oscillations determines the frequency."""
    (times_s, slow_rad), (_, quick_rad) = sine(0.3, 0.02), sine(0.9, 0.06)
    assert oscillation_hz(times_s, slow_rad + quick_rad) == pytest.approx(0.9, abs=0.01)


def test_no_oscillation() -> None:
    """Without a wave of 0.01 rad peak to peak and three periods, there is no oscillation."""
    times_s, small_rad = sine(0.4, 0.004)
    assert oscillation_hz(times_s, np.zeros(len(times_s))) is None
    assert oscillation_hz(times_s, 0.05 * times_s) is None
    assert oscillation_hz(times_s, small_rad) is None
    assert oscillation_hz(*sine(0.4, 0.006)) == pytest.approx(0.4, abs=0.01)
    assert oscillation_hz(*sine(0.4, 0.05, seconds=5.0)) is None
    assert oscillation_hz(np.zeros(0), np.zeros(0)) is None


def test_steering_metrics_without_truth_are_null() -> None:
    """All steering metrics are null without ground truth and without a steering angle."""
    assert set(steering_metrics(truth([])).values()) == {None}
    assert set(steering_metrics(truth([float("nan")] * 3)).values()) == {None}
