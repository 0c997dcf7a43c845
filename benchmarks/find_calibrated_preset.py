"""Look where the completion of drives falls, over lookahead and steering limit, beside where the paper's falls.

    python benchmarks/find_calibrated_preset.py [--repetitions 2] [--jobs N]

The paper gives no gains, only how many of 30 drives were completed under each condition. For each pair of settings
all six routes are driven in geometry fidelity, and a logistic curve is fitted to completion over injected delay.
Printed are the delay at which half of the drives are completed, the shares completed, and the deviance of the paper's
counts from those shares. The preset is not moved to wherever the deviance happens to be smallest: it is meant to put
the fall where the paper's is, and nothing else.
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

PAPER = {"L0": 30, "L1": 28, "L2": 15, "L3": 11, "L4": 9, "L5": 3}
"""Completed of 30."""
LOOKAHEADS_S = (0.70, 0.74, 0.78, 0.82)
LIMITS_RAD = (0.18, 0.21, 0.24)
NARROWEST_MS = 5.0

Counts = Mapping[str, tuple[int, int]]
"""Condition to (completed, driven)."""


def threshold_ms(counts: Counts) -> float:
    """Injected delay at which half of the drives are completed, by a logistic curve of maximum likelihood."""
    injected = conditions()
    delay_ms = np.array([injected[name].video_ms + injected[name].control_ms for name in counts])
    completed, driven = np.array(list(counts.values()), dtype=np.float64).T

    def cost(parameters: np.ndarray) -> float:
        share = expit((parameters[0] - delay_ms) / (NARROWEST_MS + math.exp(parameters[1])))
        share = np.clip(share, 1e-9, 1 - 1e-9)
        return float(-np.sum(completed * np.log(share) + (driven - completed) * np.log(1 - share)))

    return float(minimize(cost, x0=np.array([170.0, 3.0]), method="Nelder-Mead").x[0])


def deviance(counts: Counts) -> float:
    """Twice the log-likelihood that the paper's counts lose with our shares (half a drive added to both sides)."""
    total = 0.0
    for name, paper in PAPER.items():
        completed, driven = counts[name]
        ours, theirs = (completed + 0.5) / (driven + 1), paper / 30
        for share, number, other in ((ours, paper, theirs), (1 - ours, 30 - paper, 1 - theirs)):
            total += 2 * number * (math.log(other) - math.log(share)) if number else 0.0
    return total


def drive(repetitions: int, jobs: int | None) -> dict[tuple[float, float], Counts]:
    """Drive the whole grid, and count."""
    base = load_config(SweepConfig, shipped("configs/paper.yaml")).model_dump(mode="json")
    axes = {"controller.lookahead_s": list(LOOKAHEADS_S), "controller.steering_limit_rad": list(LIMITS_RAD)}
    requested = {**base, "fidelity": "geometry", "repetitions": repetitions, "axes": axes}
    planned = plan_sweep(parse_config(SweepConfig, requested, "the grid"))
    with TemporaryDirectory() as directory:
        driven, _ = run_all(planned, Path(directory), jobs=jobs, on_progress=lambda _: None)
    if driven.failed:
        raise SystemExit(f"failed: {driven.failed}")
    completed: Counter[tuple[float, float, str]] = Counter()
    total: Counter[tuple[float, float, str]] = Counter()
    for result in driven.results:
        key = (*(result["axes"][name] for name in axes), result["condition"])
        total[key] += 1
        completed[key] += result["ending"] == "completed"
    return {
        pair: {name: (completed[(*pair, name)], total[(*pair, name)]) for name in PAPER}
        for pair in itertools.product(LOOKAHEADS_S, LIMITS_RAD)
    }


def main() -> None:
    """Print the grid as a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=None)
    options = parser.parse_args()
    paper: Counts = {name: (count, 30) for name, count in PAPER.items()}
    print("| lookahead | limit | half completed at | " + " | ".join(PAPER) + " | deviance |")
    print("|---" * (4 + len(PAPER)) + "|")
    rows = [
        ("paper", "", paper),
        *((f"{k} s", f"{limit} rad", each) for (k, limit), each in drive(options.repetitions, options.jobs).items()),
    ]
    for lookahead, limit, counts in rows:
        shares = [f"{100 * completed / driven:.0f} %" for completed, driven in counts.values()]
        print(
            f"| {lookahead} | {limit} | {threshold_ms(counts):.0f} ms | "
            + " | ".join(shares)
            + f" | {deviance(counts):.0f} |"
        )


if __name__ == "__main__":
    main()
