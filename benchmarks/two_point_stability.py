"""Print which published gains of the two-point driver model are stable at 30 km/h.

    python benchmarks/two_point_stability.py

The program drives nothing. It only evaluates the model in `lavt.experiment.boundary.two_point_margin`.
"""

from __future__ import annotations

from dataclasses import replace

from lavt.control.two_point import TwoPointSettings
from lavt.experiment.boundary.delay_margin import LateralLoop
from lavt.experiment.boundary.two_point_margin import two_point_critical_delay_s

PUBLISHED_GAINS = (16.0, 4.0, 3.0)
"""Far gain, near gain and near integral gain per second of Salvucci's program, before its scale."""
SCALES = (0.40, 0.85, 1.0)
"""The scale that this program uses, the one that it has in a comment, and none."""
LOOP = LateralLoop(1.0)


def main() -> None:
    """Print the critical total delay for each scale, with and without the driver's own delay, and two near points."""
    for scale in SCALES:
        far, near, integral = (scale * gain for gain in PUBLISHED_GAINS)
        driver = replace(TwoPointSettings(), far_gain=far, near_gain=near, near_integral_gain_per_s=integral)
        for near_m in (10.0, 8.0):
            for delay_s, lag_s in ((0.0, 0.0), (0.12, 0.11), (0.2, 0.11)):
                model = replace(driver, near_point_m=near_m, reaction_delay_s=delay_s, neuromuscular_lag_s=lag_s)
                critical_ms = 1e3 * two_point_critical_delay_s(LOOP, model)
                print(f"x {scale}, near {near_m:.0f} m, delay {delay_s} s, lag {lag_s} s: {critical_ms:.0f} ms")


if __name__ == "__main__":
    main()
