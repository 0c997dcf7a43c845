"""Drive the paper's campaign four times, each time with other processes, and compare the digests of all runs.

    python benchmarks/digests.py [--fidelity geometry] [--repetitions 5] [--jobs 2]

The campaign runs twice in `--jobs` processes, once in one process, and once with Dask's workers on this machine. By
default it has 180 runs in the fidelity `geometry`. With `--fidelity video --repetitions 1` it has 36 runs with pixels
and H.264.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from lavt.clock import MachineClock
from lavt.config import SweepConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_S
from lavt.experiment.runs.plan import PlannedRun, plan_sweep
from lavt.experiment.sweep.sweep import run_all


def digests(planned: list[PlannedRun], jobs: int, cluster_address: str | None) -> dict[str, str]:
    """Run everything, and return the digests by run id."""
    with TemporaryDirectory() as directory:
        sweep_result, _ = run_all(
            planned, Path(directory), jobs=jobs, on_progress=lambda _: None, cluster_address=cluster_address
        )
    if sweep_result.failed:
        raise SystemExit(f"failed: {sweep_result.failed}")
    return {result["run"]: result["digest"] for result in sweep_result.results}


def main() -> None:
    """Print for each campaign how many of its digests differ from the first campaign's, and the time it took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fidelity", default="geometry", choices=["video", "pixels", "geometry"])
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    changes = [f"fidelity={options.fidelity}", f"repetitions={options.repetitions}"]
    planned = plan_sweep(load_config(SweepConfig, shipped("configs/paper.yaml"), changes))
    campaigns = {
        f"{options.jobs} jobs": (options.jobs, None),
        f"{options.jobs} jobs, again": (options.jobs, None),
        "1 job": (1, None),
        f"Dask, {options.jobs} workers": (options.jobs, "local"),
    }
    clock, first_digests = MachineClock(), None
    for name, (jobs, cluster_address) in campaigns.items():
        begin_ns = clock.now().mono_ns
        run_digests = digests(planned, jobs, cluster_address)
        first_digests = first_digests or run_digests
        different = sum(first_digests[run] != digest for run, digest in run_digests.items())
        took_s = (clock.now().mono_ns - begin_ns) / NS_PER_S
        print(f"{name}: {len(run_digests)} runs, {different} digests differ, {took_s:.0f} s", flush=True)


if __name__ == "__main__":
    main()
