"""Measure how many drives are completed with each lookahead and steering limit, and compare that with the paper.

    python benchmarks/find_calibrated_preset.py [--repetitions 2] [--jobs N]

The paper gives no gains, only how many of 30 drives were completed under each condition. For each pair of a lookahead
and a steering limit, the program drives all six routes in geometry fidelity. It fits a logistic curve to the share of
completed drives over the injected delay. The output has the delay at which half of the drives are completed, the shares
of completed drives, and the deviance of the paper's counts from these shares. The preset need not be the pair with the
smallest deviance. It only has to make the share fall at the same delay as in the paper.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from lavt.config import SweepConfig
from lavt.config_file import conditions, load_config, parse_config, shipped
from lavt.experiment.runs.plan import plan_sweep
from lavt.experiment.sweep.sweep import run_all

PAPER_RUNS = 30
"""The paper's number of drives under each condition."""
PAPER_COMPLETED = {"L0": 30, "L1": 28, "L2": 15, "L3": 11, "L4": 9, "L5": 3}
"""The paper's number of completed drives under each condition."""
LOOKAHEADS_S = (0.70, 0.74, 0.78, 0.82)
STEERING_LIMITS_RAD = (0.18, 0.21, 0.24)
MIN_WIDTH_MS = 5.0
"""The smallest width of the fitted logistic curve."""

Counts = Mapping[str, tuple[int, int]]
"""The numbers of completed drives and of all drives by condition."""


def threshold_ms(counts: Counts) -> float:
    """Return the injected delay at which half of the drives are completed, from a maximum-likelihood logistic curve."""
    injected = conditions()
    delay_ms = np.array([injected[name].video_ms + injected[name].control_ms for name in counts])
    completed, runs = np.array(list(counts.values()), dtype=np.float64).T

    def cost(parameters: np.ndarray) -> float:
        centre_ms, log_width = parameters
        share = expit((centre_ms - delay_ms) / (MIN_WIDTH_MS + math.exp(log_width)))
        share = np.clip(share, 1e-9, 1 - 1e-9)
        return float(-np.sum(completed * np.log(share) + (runs - completed) * np.log(1 - share)))

    return float(minimize(cost, x0=np.array([170.0, 3.0]), method="Nelder-Mead").x[0])


def deviance(counts: Counts) -> float:
    """Return the deviance of the paper's counts from our shares; `counts` are ours.

    The deviance is twice the difference between the log-likelihoods of the paper's counts with the paper's shares and
    with our shares. Half a completed and half a failed drive are added to our counts, so that no share of ours is 0
    or 1.
    """
    total = 0.0
    for name, paper_completed in PAPER_COMPLETED.items():
        completed, runs = counts[name]
        our_share, paper_share = (completed + 0.5) / (runs + 1), paper_completed / PAPER_RUNS
        completed_drives = (paper_completed, paper_share, our_share)
        failed_drives = (PAPER_RUNS - paper_completed, 1 - paper_share, 1 - our_share)
        for paper_count, in_paper, in_ours in (completed_drives, failed_drives):
            total += 2 * paper_count * (math.log(in_paper) - math.log(in_ours)) if paper_count else 0.0
    return total


def run_grid(repetitions: int, jobs: int | None) -> dict[tuple[float, float], Counts]:
    """Drive with all pairs of lookahead (s) and steering limit (rad), and return the counts by pair."""
    base = load_config(SweepConfig, shipped("configs/paper.yaml")).model_dump(mode="json")
    axes = {"controller.lookahead_s": list(LOOKAHEADS_S), "controller.steering_limit_rad": list(STEERING_LIMITS_RAD)}
    config = {**base, "fidelity": "geometry", "repetitions": repetitions, "axes": axes}
    planned = plan_sweep(parse_config(SweepConfig, config, "the grid"))
    with TemporaryDirectory() as directory:
        sweep_result, _ = run_all(planned, Path(directory), jobs=jobs, on_progress=lambda _: None)
    if sweep_result.failed:
        raise SystemExit(f"failed: {sweep_result.failed}")
    completed: Counter[tuple[float, float, str]] = Counter()
    total: Counter[tuple[float, float, str]] = Counter()
    for result in sweep_result.results:
        key = (*(result["axes"][name] for name in axes), result["condition"])
        total[key] += 1
        completed[key] += result["ending"] == "completed"
    return {
        pair: {name: (completed[(*pair, name)], total[(*pair, name)]) for name in PAPER_COMPLETED}
        for pair in itertools.product(LOOKAHEADS_S, STEERING_LIMITS_RAD)
    }


def main() -> None:
    """Print the grid as a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=None)
    options = parser.parse_args()
    paper: Counts = {name: (count, PAPER_RUNS) for name, count in PAPER_COMPLETED.items()}
    print("| lookahead | limit | half completed at | " + " | ".join(PAPER_COMPLETED) + " | deviance |")
    print("|---" * (4 + len(PAPER_COMPLETED)) + "|")
    rows = [
        ("paper", "", paper),
        *(
            (f"{lookahead_s} s", f"{limit_rad} rad", counts)
            for (lookahead_s, limit_rad), counts in run_grid(options.repetitions, options.jobs).items()
        ),
    ]
    for lookahead, limit, counts in rows:
        shares = [f"{100 * completed / runs:.0f} %" for completed, runs in counts.values()]
        print(
            f"| {lookahead} | {limit} | {threshold_ms(counts):.0f} ms | "
            + " | ".join(shares)
            + f" | {deviance(counts):.0f} |"
        )


if __name__ == "__main__":
    main()
