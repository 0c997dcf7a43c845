"""Find the lookahead of the preset `designed`: the smallest one with 30 degrees of phase margin at L0.

    python benchmarks/find_designed_preset.py

The program drives nothing. It only evaluates the model in `lavt.experiment.boundary.delay_margin`.
"""

from __future__ import annotations

import math

from lavt.experiment.boundary.delay_margin import LateralLoop, critical_delay_s, phase_margin_rad, smallest_lookahead_s

MARGIN_RAD = math.radians(30)
VIDEO_S = 0.062
"""Median latency of the video with `paper_wifi5`: the time between writing a stamp and reading it."""
CONTROL_S = 0.009
"""Median latency of the control with `paper_wifi5`."""
PROCESSING_S = 0.010
"""Time for perception, control and applying the command. The wait for the next frame is not in it, but in the model."""
CALIBRATED_LOOKAHEAD_S = 0.74
"""Lookahead of the preset `paper_calibrated`, for comparison."""


def main() -> None:
    """Print the lookahead, and the margins of both presets."""
    delay_s = VIDEO_S + CONTROL_S + PROCESSING_S
    smallest_s = smallest_lookahead_s(MARGIN_RAD, delay_s)
    rounded_s = math.ceil(smallest_s * 100) / 100
    print(f"total delay at L0              {1e3 * delay_s:.0f} ms")
    print(f"smallest lookahead for 30 deg  {smallest_s:.4f} s, rounded up {rounded_s:.2f} s")
    for name, lookahead_s in (("designed", rounded_s), ("paper_calibrated", CALIBRATED_LOOKAHEAD_S)):
        loop = LateralLoop(lookahead_s)
        margin_deg = math.degrees(phase_margin_rad(loop, delay_s))
        critical_ms = 1e3 * critical_delay_s(loop)
        print(f"{name:17s} {lookahead_s:.2f} s: margin {margin_deg:.1f} deg at L0, critical delay {critical_ms:.0f} ms")


if __name__ == "__main__":
    main()
