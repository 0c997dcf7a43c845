"""Steering metrics: pure functions of the recorded ground truth. `docs/metrics.md` has the formulas."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavt.domain import NS_PER_S, FloatArray
from lavt.experiment.analysis.tracking import distance_m, per_km, root_mean_square, sampled_by_distance
from lavt.recording.table import Table

REVERSAL_DEADBAND_RAD = 0.01
"""A steering reversal is a turn in the opposite direction by more than this angle of the road wheels (0.57 degrees)."""

MAX_DURATION_S = 24 * 3600
"""A longer time cannot be one drive, and its samples would fill the memory."""

SAMPLE_RATE_HZ = 20.0
"""The steering is resampled at this rate for its spectrum. No road wheel oscillates at half this rate or faster."""
LOWEST_HZ, HIGHEST_HZ = 0.1, 5.0
"""The limits of the oscillation frequency. Slower steering follows the road, and faster steering is noise. The
control loop's own frequency lies between the limits (`delay_margin.py`)."""
FEWEST_PERIODS = 3
"""An oscillation has at least this many periods in the drive. Fewer periods can come from bends of the road."""


def steering_metrics(truth: Table) -> dict[str, Any]:
    """Return the RMS of the road wheels' angle and of its rate, the reversal rates, and the oscillation frequency."""
    mono_ns, steering_rad = truth.ints("mono_ns"), truth.floats("steering_rad")
    known = np.isfinite(steering_rad)
    times_s, angle_rad = (mono_ns[known] - (mono_ns[known][0] if known.any() else 0)) / NS_PER_S, steering_rad[known]
    reversal_count, driven_m = steering_reversals(angle_rad), distance_m(truth)
    duration_s = float(times_s[-1]) if len(times_s) else 0.0
    return {
        "steering_rms_rad": root_mean_square(sampled_by_distance(truth, "steering_rad")),
        "steering_rate_rms_radps": steering_rate_rms_radps(times_s, angle_rad),
        "steering_reversals_per_s": reversal_count / duration_s if duration_s > 0 else None,
        "steering_reversals_per_km": per_km(reversal_count, driven_m) if len(times_s) else None,
        "oscillation_hz": oscillation_hz(times_s, angle_rad),
    }


def steering_rate_rms_radps(times_s: FloatArray, steering_rad: FloatArray) -> float | None:
    """Return the time-weighted RMS of the steering rate between samples; None for fewer than two different times."""
    step_s = np.diff(times_s)
    if not (step_s > 0).any():
        return None
    turned_rad, step_s = np.diff(steering_rad)[step_s > 0], step_s[step_s > 0]
    return float(np.sqrt(np.sum(turned_rad**2 / step_s) / np.sum(step_s)))


def oscillation_hz(times_s: FloatArray, steering_rad: FloatArray) -> float | None:
    """Return the frequency of the strongest steering oscillation.

    This is the frequency of the highest peak of the periodogram (Hann window, mean and slope removed) between
    `LOWEST_HZ` and `HIGHEST_HZ`, with at least `FEWEST_PERIODS` in the drive. The result is None without such a peak,
    and if the peak-to-peak amplitude of the corresponding sine is at most `REVERSAL_DEADBAND_RAD`.
    """
    duration_s = float(times_s[-1] - times_s[0]) if len(times_s) else 0.0
    if duration_s > MAX_DURATION_S:
        raise ValueError(f"a drive of more than {MAX_DURATION_S // 3600} hours")
    sampled_s = np.arange(0.0, duration_s, 1 / SAMPLE_RATE_HZ)
    if duration_s < FEWEST_PERIODS / HIGHEST_HZ:
        return None
    sampled_rad = np.interp(sampled_s, times_s - times_s[0], steering_rad)
    hertz, power = power_spectrum(sampled_rad)
    peaks = 1 + np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:]))
    peaks = peaks[(hertz[peaks] >= max(LOWEST_HZ, FEWEST_PERIODS / duration_s)) & (hertz[peaks] <= HIGHEST_HZ)]
    if len(peaks) == 0:
        return None
    highest = peaks[np.argmax(power[peaks])]
    peak_to_peak_rad = 2 * np.sqrt(2 * power[highest])  # a sine of amplitude a has the power a^2 / 2
    return float(hertz[highest]) if peak_to_peak_rad > REVERSAL_DEADBAND_RAD else None


def power_spectrum(sampled_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return frequencies in Hz and the power at each of them, for angles sampled at `SAMPLE_RATE_HZ`.

    The power of a sine is amplitude^2 / 2. `scipy.signal.periodogram` with `scaling="spectrum"` gives the same result,
    but the import of `scipy.signal` takes longer than a short drive without pixels.
    """
    index = np.arange(len(sampled_rad))
    trend = np.polynomial.Polynomial.fit(index, sampled_rad, 1)(index)
    window = np.hanning(len(sampled_rad) + 1)[:-1]
    # Without zero padding, neighbouring frequencies would differ by 1 / (duration of the drive), too much to locate a
    # peak.
    padded_length = 1 << (8 * len(sampled_rad) - 1).bit_length()
    amplitudes = np.abs(np.fft.rfft((sampled_rad - trend) * window, padded_length)) / window.sum()
    hertz = np.fft.rfftfreq(padded_length, 1 / SAMPLE_RATE_HZ)
    return np.asarray(hertz, np.float64), np.asarray(2 * amplitudes**2, np.float64)


def steering_reversals(steering_rad: FloatArray) -> int:
    """Return how often the steering turned back from its last extreme value by more than `REVERSAL_DEADBAND_RAD`."""
    count, direction = 0, 0
    extreme = lowest = highest = steering_rad[0] if len(steering_rad) else 0.0
    for angle in steering_rad.tolist():
        if direction == 0:  # the direction is unknown: the first turn determines it and is not a reversal
            lowest, highest = min(lowest, angle), max(highest, angle)
            if highest - lowest > REVERSAL_DEADBAND_RAD:
                direction, extreme = (1 if angle == highest else -1), angle
        elif (angle - extreme) * direction > 0:
            extreme = angle
        elif (extreme - angle) * direction > REVERSAL_DEADBAND_RAD:
            count, direction, extreme = count + 1, -direction, angle
    return count
