"""How the car was steered: pure functions of the recorded ground truth. `docs/metrics.md` has the formulas."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavt.domain import NS_PER_S, FloatArray
from lavt.experiment.analysis.tracking import distance_m, per_km, root_mean_square, sampled_by_distance
from lavt.recording.table import Table

REVERSAL_DEADBAND_RAD = 0.01
"""Smallest turn back of the road wheels that counts as a steering reversal (0.57 degrees)."""

SAMPLED_HZ = 20.0
"""The steering is brought to this rate to find its frequency: no wheel oscillates at half of it."""
LOWEST_HZ, HIGHEST_HZ = 0.1, 5.0
"""Slower is the road, faster is noise: the loop's own frequency lies between, `theory.py`."""
FEWEST_PERIODS = 3
"""An oscillation is seen at least so often; fewer swings could be bends."""


def steering(truth: Table) -> dict[str, Any]:
    """Tell of the road wheels' angle: root mean square of it and of its rate, turns back, and its oscillation."""
    mono_ns, steering_rad = truth.ints("mono_ns"), truth.floats("steering_rad")
    known = np.isfinite(steering_rad)
    at_s, angle_rad = (mono_ns[known] - (mono_ns[known][0] if known.any() else 0)) / NS_PER_S, steering_rad[known]
    turns, driven_m, lasted_s = steering_reversals(angle_rad), distance_m(truth), float(at_s[-1]) if len(at_s) else 0.0
    return {
        "steering_rms_rad": root_mean_square(sampled_by_distance(truth, "steering_rad")),
        "steering_rate_rms_radps": steering_rate_rms_radps(at_s, angle_rad),
        "steering_reversals_per_s": turns / lasted_s if lasted_s > 0 else None,
        "steering_reversals_per_km": per_km(turns, driven_m) if len(at_s) else None,
        "oscillation_hz": oscillation_hz(at_s, angle_rad),
    }


def steering_rate_rms_radps(at_s: FloatArray, steering_rad: FloatArray) -> float | None:
    """Root of the mean over time of the square of the steering's rate, taken between rows; None of fewer than two."""
    step_s = np.diff(at_s)
    if not (step_s > 0).any():
        return None
    turned_rad, step_s = np.diff(steering_rad)[step_s > 0], step_s[step_s > 0]
    return float(np.sqrt(np.sum(turned_rad**2 / step_s) / np.sum(step_s)))


def oscillation_hz(at_s: FloatArray, steering_rad: FloatArray) -> float | None:
    """Frequency at which the steering swings most; None where no swing is wider than `REVERSAL_DEADBAND_RAD`.

    It is the highest peak of the periodogram (Hann's window, mean and slope taken off) between `LOWEST_HZ` and
    `HIGHEST_HZ` with at least `FEWEST_PERIODS` in the drive.
    """
    lasted_s = float(at_s[-1] - at_s[0]) if len(at_s) else 0.0
    even_s = np.arange(0.0, lasted_s, 1 / SAMPLED_HZ)
    if lasted_s < FEWEST_PERIODS / HIGHEST_HZ:
        return None
    even_rad = np.interp(even_s, at_s - at_s[0], steering_rad)
    hertz, power = power_spectrum(even_rad)
    peaks = 1 + np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:]))
    peaks = peaks[(hertz[peaks] >= max(LOWEST_HZ, FEWEST_PERIODS / lasted_s)) & (hertz[peaks] <= HIGHEST_HZ)]
    if len(peaks) == 0:
        return None
    highest = peaks[np.argmax(power[peaks])]
    swing_rad = 2 * np.sqrt(2 * power[highest])  # a sine of amplitude a has the power a^2 / 2, and swings by 2 a
    return float(hertz[highest]) if swing_rad > REVERSAL_DEADBAND_RAD else None


def power_spectrum(even_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frequencies, and the power at each of what was sampled at `SAMPLED_HZ`: that of a sine is half its square.

    As `scipy.signal.periodogram` with `scaling="spectrum"`, whose import takes longer than a short geometry drive.
    """
    at = np.arange(len(even_rad))
    straight = np.polynomial.Polynomial.fit(at, even_rad, 1)(at)
    window = np.hanning(len(even_rad) + 1)[:-1]
    # Longer than the drive, filled up with zeros: the peak is then found finer than one period in the drive.
    length = 1 << (8 * len(even_rad) - 1).bit_length()
    amplitudes = np.abs(np.fft.rfft((even_rad - straight) * window, length)) / window.sum()
    return np.asarray(np.fft.rfftfreq(length, 1 / SAMPLED_HZ), np.float64), np.asarray(2 * amplitudes**2, np.float64)


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
