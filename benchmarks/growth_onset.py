"""Measure the total delay at which an oscillation begins to grow on a straight road, and compare it with theory.

    python benchmarks/growth_onset.py [--lookaheads 0.74,1.01,1.3] [--rates 15,30] [--speeds 6,10] [--seeds 1]

The drives use geometry fidelity, the inherent latency `loopback`, and a constant delay of the video. As long as the
oscillation is measured, neither steering nor speed reaches a limit. `docs/boundary.md` has the output.
"""

from __future__ import annotations

import argparse
import itertools
from statistics import median

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.boundary.bisection import Bracket, zero_bracket
from lavt.experiment.boundary.boundary import theoretical_ms, with_video_delay
from lavt.experiment.boundary.oscillation_growth import straight_growth
from lavt.experiment.report.table_format import NOTHING

MAX_DELAY_MS = 1000.0
"""The longest added delay of the video."""
PRECISION_MS = 0.5


def case(lookahead_s: float, rate_hz: float, speed_mps: float, seed: int) -> RunConfig:
    """Return the config of one case."""
    changes = [
        "fidelity=geometry",
        f"seed={seed}",
        f"controller.lookahead_s={lookahead_s}",
        f"controller.speed_mps={speed_mps}",
        f"camera.rate_hz={rate_hz}",
        "safety.stopping_distance_limit_m=200",  # the speed must not depend on the delay
        "safety.speed_limit_mps=22.3",
    ]
    return load_config(RunConfig, shipped("configs/demo.yaml"), changes)


def onset_bracket(config: RunConfig, theory_ms: float | None) -> Bracket:
    """Return the total delays between which the oscillation begins to grow; an end is None if it was not found."""
    other_delays_ms = []  # of each drive: the total delay minus the added delay of the video

    def growth(added_ms: float) -> float:
        total_ms, growth_per_s = straight_growth(with_video_delay(config, added_ms))
        other_delays_ms.append(total_ms - added_ms)
        return growth_per_s

    bracket = zero_bracket(growth, theory_ms or 0.0, MAX_DELAY_MS, PRECISION_MS)
    other_ms = median(other_delays_ms)
    low_ms, high_ms = (None if end_ms is None else end_ms + other_ms for end_ms in (bracket.low_ms, bracket.high_ms))
    return Bracket(low_ms, high_ms)


def onset_ms(bracket: Bracket) -> float | None:
    """Return the middle of a bracket; None if the onset is outside the searched delays."""
    if bracket.low_ms is None or bracket.high_ms is None:
        return None
    return (bracket.low_ms + bracket.high_ms) / 2


def table_row(
    lookahead_s: float, rate_hz: float, speed_mps: float, theory_ms: float | None, measured_ms: float | None
) -> str:
    """Return the table's row of one case, with a dash for each value that does not exist."""
    difference_ms = None if theory_ms is None or measured_ms is None else measured_ms - theory_ms
    values = ((theory_ms, ".1f"), (measured_ms, ".1f"), (difference_ms, "+.1f"))
    cells = [
        f"{lookahead_s:g} s",
        f"{rate_hz:g} Hz",
        f"{speed_mps:g} m/s",
        *(NOTHING if value_ms is None else f"{value_ms:{form}} ms" for value_ms, form in values),
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print all cases as a Markdown table, and the reason for its dashes."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("lookaheads", "0.74,1.01,1.3"), ("rates", "15,30"), ("speeds", "6,10")):
        parser.add_argument(f"--{name}", type=lambda text: [float(item) for item in text.split(",")], default=default)
    parser.add_argument("--seeds", type=lambda text: [int(item) for item in text.split(",")], default="1")
    options = parser.parse_args()
    print("| lookahead | frame rate | speed | theory | measured | difference |")
    print("|---" * 6 + "|")
    rows = []
    for lookahead_s, rate_hz, speed_mps, seed in itertools.product(
        options.lookaheads, options.rates, options.speeds, options.seeds
    ):
        config = case(lookahead_s, rate_hz, speed_mps, seed)
        theory_ms = theoretical_ms(config)
        measured_ms = onset_ms(onset_bracket(config, theory_ms))
        rows.append(table_row(lookahead_s, rate_hz, speed_mps, theory_ms, measured_ms))
        print(rows[-1], flush=True)
    if any(NOTHING in row for row in rows):
        print(f"\n{NOTHING}: no growing oscillation by theory, or none measured with 0 to {MAX_DELAY_MS:g} ms added")


if __name__ == "__main__":
    main()
