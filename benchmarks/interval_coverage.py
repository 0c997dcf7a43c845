"""Measure how often the intervals of the mean error contain the true mean, by simulation.

    python benchmarks/interval_coverage.py [--experiments 2000]

An experiment draws the values of runs, and computes the interval. The share of the experiments whose interval contains
the true mean is the coverage; it should be 95 %. The values are normally distributed, lognormally (the logarithm has a
standard deviation of 1), or normally with one route that spreads five times as much as the others. "These routes" is
`stratified_interval` of six routes, compared with two bootstraps: the percentile bootstrap, which LAVT used before, and
the studentised bootstrap. "Other roads" is `cluster_interval` of one value for each road. The seed is fixed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

import numpy as np

from lavt.domain import FloatArray
from lavt.experiment.statistics.intervals import cluster_interval, stratified_interval
from lavt.streams import stream

ROUTES = 6
RUNS_ON_A_ROUTE = (2, 3, 5, 10)
ROADS = (6, 12, 30)
RESAMPLES = 1000
"""Of the two bootstraps that serve as a comparison; more resamples change their coverage by less than is shown."""

Method = Callable[[FloatArray, np.random.Generator], Sequence[float] | None]
"""A function that returns the interval of the mean of values, of the shape (routes, runs)."""

Draw = Callable[[np.random.Generator, tuple[int, int]], FloatArray]

DISTRIBUTIONS: dict[str, tuple[Draw, float]] = {
    "normal": (lambda generator, shape: generator.standard_normal(shape), 0.0),
    "lognormal": (lambda generator, shape: np.exp(generator.standard_normal(shape)), float(np.exp(0.5))),
    "one route spreads more": (
        lambda generator, shape: generator.standard_normal(shape) * np.where(np.arange(shape[0]) == 0, 5, 1)[:, None],
        0.0,
    ),
}
"""For each distribution, the function that draws values of a shape, and the true mean."""


def resampled(values: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return resamples of the runs of each route, of the shape (resamples, routes, runs)."""
    shape = (RESAMPLES, *values.shape)
    indexes = generator.integers(0, values.shape[1], shape)
    return np.take_along_axis(np.broadcast_to(values, shape), indexes, axis=2)


def standard_errors(values: FloatArray) -> FloatArray:
    """Return the standard error of the mean of all values, from the spread within each route (last axis)."""
    routes, runs = values.shape[-2:]
    return np.asarray(np.sqrt(values.var(axis=-1, ddof=1).sum(axis=-1) / runs) / routes, np.float64)


def percentile_bootstrap(values: FloatArray, generator: np.random.Generator) -> Sequence[float]:
    """Return the interval from the 2.5th to the 97.5th percentile of the resampled means."""
    low, high = np.percentile(resampled(values, generator).mean(axis=(1, 2)), [2.5, 97.5])
    return float(low), float(high)


def studentised_bootstrap(values: FloatArray, generator: np.random.Generator) -> Sequence[float]:
    """Return the interval from the percentiles of the resampled means' t values, infinite without spread."""
    resamples = resampled(values, generator)
    deviations, errors = resamples.mean(axis=(1, 2)) - values.mean(), standard_errors(resamples)
    with np.errstate(divide="ignore", invalid="ignore"):
        t_values = np.nan_to_num(deviations / errors, nan=0.0, posinf=1e300, neginf=-1e300)
    low, high = np.percentile(t_values, [2.5, 97.5], method="nearest")
    error = float(standard_errors(values))
    return float(values.mean() - high * error), float(values.mean() - low * error)


def by_road(values: FloatArray, _generator: np.random.Generator) -> Sequence[float] | None:
    """Return LAVT's interval for other roads, from one run on each road."""
    return cluster_interval(values[:, 0].tolist())


METHODS: dict[str, Method] = {
    "percentile bootstrap": percentile_bootstrap,
    "studentised bootstrap": studentised_bootstrap,
    "LAVT": lambda values, _generator: stratified_interval(values.tolist()),
}


def coverage(method: Method, distribution: str, shape: tuple[int, int], experiments: int) -> float:
    """Return the share of the experiments whose interval contains the true mean."""
    draw, true_mean = DISTRIBUTIONS[distribution]
    draws, resampling = stream(1, f"values {distribution} {shape}"), stream(1, "resamples")
    covered = 0
    for _ in range(experiments):
        low, high = method(draw(draws, shape), resampling) or (np.inf, -np.inf)
        covered += low <= true_mean <= high
    return covered / experiments


def main(arguments: Sequence[str]) -> int:
    """Print the coverage of each interval as Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", type=int, default=2000)
    experiments = parser.parse_args(arguments).experiments
    print("| these routes: values | runs on each | " + " | ".join(METHODS) + " |")
    print("|---" * (len(METHODS) + 2) + "|")
    for distribution in DISTRIBUTIONS:
        for runs in RUNS_ON_A_ROUTE:
            shares = [coverage(method, distribution, (ROUTES, runs), experiments) for method in METHODS.values()]
            print(f"| {distribution} | {runs} | " + " | ".join(f"{share:.1%}" for share in shares) + " |", flush=True)
    print("\n| other roads: values | roads | LAVT |\n|---|---|---|")
    for distribution in ("normal", "lognormal"):
        for roads in ROADS:
            share = coverage(by_road, distribution, (roads, 1), experiments)
            print(f"| {distribution} | {roads} | {share:.1%} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
