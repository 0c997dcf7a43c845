"""Write the two traces in this folder, which are synthetic, not measured: python netem/traces/make_traces.py."""

from __future__ import annotations

import math
from pathlib import Path

PERIOD_MS = 10_000
LEAST_BPS, MOST_BPS = 1.5e6, 8.5e6
OPPORTUNITY_BITS = 1500 * 8


def fading() -> str:
    """Return a capacity that varies like a cosine, in Mahimahi's format with opportunities of 1500 bytes."""
    lines, bits = [], 0.0
    for millisecond in range(1, PERIOD_MS + 1):
        share = (1 + math.cos(2 * math.pi * millisecond / PERIOD_MS)) / 2
        bits += (LEAST_BPS + share * (MOST_BPS - LEAST_BPS)) / 1000
        while bits >= OPPORTUNITY_BITS:
            bits -= OPPORTUNITY_BITS
            lines.append(millisecond)
    if lines[-1] != PERIOD_MS:
        lines.append(PERIOD_MS)
    return "".join(f"{millisecond}\n" for millisecond in lines)


def handover() -> str:
    """Return a delay of 20 ms that every 10 s rises to 180 ms, in 0.2 s, and falls back, in a second; in CSV."""
    points = [(0.0, 20), (6.0, 20), (6.2, 180), (7.2, 20), (10.0, 20)]
    return "time_s,delay_ms\n" + "".join(f"{time_s:g},{delay_ms}\n" for time_s, delay_ms in points)


if __name__ == "__main__":
    folder = Path(__file__).parent
    (folder / "fading.mahimahi").write_text(fading())
    (folder / "handover.csv").write_text(handover())
