"""Drive the same runs in real and in virtual time, and print how well they agree.

Each run is driven in real time, in virtual time with measured costs, and in virtual time with constant costs, all with
the same seed. The program prints P95 of the cross-track error, median and 95th percentile of the loop latency, loop
jitter, and whether the route was completed, and completed in the own lane. Then it prints the agreement with real time
for each condition: the differences of the medians over the valid runs, and the numbers of equal outcomes.

Real time needs a quiet machine: before each real run the program observes the machine for 3 s, and ends if it is busy.
`docs/virtual_time.md` has the limits of the agreement, and the time that this takes.

    python benchmarks/real_vs_virtual.py [--routes a_key ...] [--conditions L0 L1 ...] [--repetitions 1] [--out DIR]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.quiet import BUSY_LIMIT, require_quiet

from lavt.config import SweepConfig
from lavt.config_file import load_config, shipped
from lavt.errors import LavtError
from lavt.experiment.analysis.results import write_json
from lavt.experiment.runs.plan import PlannedRun, plan_sweep
from lavt.experiment.runs.run import run_once

KINDS = {
    "real": ("time=real",),
    "virtual": ("time=virtual", "costs=measured"),
    "constant": ("time=virtual", "costs=constant"),
}
"""By kind of time, the changes of the config."""
LOOP_LIMIT_MS = 5.0
"""Median and 95th percentile of the loop latency agree if they differ by at most this much."""
P95_LIMIT = 0.2
P95_LIMIT_M = 0.1
"""P95 of the cross-track error agrees if it differs by at most a fifth of the real value, or by 0.1 m."""

Result = dict[str, Any]


def plans(
    routes: Sequence[str], conditions: Sequence[str], repetitions: int, changes: Sequence[str]
) -> dict[str, list[PlannedRun]]:
    """Plan the same runs for each kind of time."""
    planned = {}
    for kind, kind_changes in KINDS.items():
        config = load_config(SweepConfig, shipped("configs/demo.yaml"), [*kind_changes, *changes])
        config = config.model_copy(
            update={"routes": tuple(routes), "conditions": tuple(conditions), "repetitions": repetitions}
        )
        planned[kind] = plan_sweep(config)
    return planned


def result_row(kind: str, result: Result, busy: float | None) -> str:
    """Return one line of the table of runs."""
    loop, remarks = result["loop_ms"], [reason["code"] for reason in result["invalid_reasons"]]
    if busy is not None and busy > BUSY_LIMIT:
        remarks.append(f"machine {busy:.0%} busy")
    times_ms = (loop["p50"], loop["p95"], result["loop_jitter_ms"])
    return (
        f"{result['run']:16}{kind:10}{number(result['p95_m'], 2):>9}"
        + "".join(f"{number(time_ms, 1):>10}" for time_ms in times_ms)
        + f"{yes(result['ending'] == 'completed'):>11}{yes(result['completed_in_own_lane']):>10}  {', '.join(remarks)}"
    )


HEAD = (
    f"{'run':16}{'time':10}{'P95, m':>9}{'loop p50':>10}{'loop p95':>10}{'jitter':>10}{'completed':>11}{'own lane':>10}"
)


def number(value: float | None, digits: int) -> str:
    """Return a number as text; a dash for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def yes(value: bool | None) -> str:
    """Return a truth value as text; a dash for None."""
    return "-" if value is None else "yes" if value else "no"


def middle(results: Sequence[Result], *keys: str) -> float | None:
    """Return the median over runs of a value at nested keys; None without values."""
    values = []
    for result in results:
        value: Any = result
        for key in keys:
            value = value[key]
        if value is not None:
            values.append(float(value))
    return median(values) if values else None


def difference(real: float | None, compared: float | None) -> float | None:
    """Return compared minus real; None if one of them is unknown."""
    return None if real is None or compared is None else compared - real


def agreement(pairs: Sequence[tuple[Result, Result]]) -> Result:
    """Return how pairs of a real and a virtual run of one condition agree; pairs with an invalid run are left out.

    `agrees` is None without a valid pair.
    """
    valid = [pair for pair in pairs if pair[0]["valid"] and pair[1]["valid"]]
    real, virtual = [pair[0] for pair in valid], [pair[1] for pair in valid]
    p50_ms, p95_ms = (difference(middle(real, "loop_ms", p), middle(virtual, "loop_ms", p)) for p in ("p50", "p95"))
    real_m = middle(real, "p95_m")
    p95_m = difference(real_m, middle(virtual, "p95_m"))
    completed = sum((one["ending"] == "completed") == (other["ending"] == "completed") for one, other in valid)
    own_lane = sum(one["completed_in_own_lane"] == other["completed_in_own_lane"] for one, other in valid)
    agrees = None
    if p50_ms is not None and p95_ms is not None and p95_m is not None and real_m is not None:
        agrees = (
            max(abs(p50_ms), abs(p95_ms)) <= LOOP_LIMIT_MS
            and abs(p95_m) <= max(P95_LIMIT * real_m, P95_LIMIT_M)
            and completed == len(valid)
        )
    return {
        "valid": len(valid),
        "runs": len(pairs),
        "loop_p50_ms": p50_ms,
        "loop_p95_ms": p95_ms,
        "p95_m": p95_m,
        "completed": completed,
        "own_lane": own_lane,
        "agrees": agrees,
    }


def print_agreement(results: Sequence[dict[str, Result]]) -> list[Result]:
    """Print the agreement of each condition, for both kinds of costs, and return it."""
    print("\nvirtual minus real time, medians over the valid pairs of runs; equal outcomes of these pairs")
    print(
        f"{'condition':12}{'costs':12}{'valid':>7}{'P95, m':>9}{'loop p50, ms':>14}{'loop p95, ms':>14}"
        f"{'completed':>11}{'own lane':>10}  agrees"
    )
    rows = []
    for condition in dict.fromkeys(result["real"]["condition"] for result in results):
        of_condition = [result for result in results if result["real"]["condition"] == condition]
        for kind, costs in (("virtual", "measured"), ("constant", "constant")):
            row = agreement([(result["real"], result[kind]) for result in of_condition])
            rows.append({"condition": condition, "costs": costs, **row})
            print(
                f"{condition:12}{costs:12}{row['valid']:>4}/{row['runs']:<2}{number(row['p95_m'], 2):>9}"
                f"{number(row['loop_p50_ms'], 1):>14}{number(row['loop_p95_ms'], 1):>14}"
                f"{row['completed']:>8}/{row['valid']:<2}{row['own_lane']:>7}/{row['valid']:<2}  {yes(row['agrees'])}"
            )
    measured = [row["agrees"] for row in rows if row["costs"] == "measured" and row["agrees"] is not None]
    print(f"\nreal and virtual time with measured costs agree under {sum(measured)} of {len(measured)} conditions")
    return rows


def main() -> None:
    """Drive all runs, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--routes", nargs="+", default=["a_key"])
    parser.add_argument("--conditions", nargs="+", default=["L0", "L1", "L2", "L3", "L4", "L5"])
    parser.add_argument("--repetitions", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], dest="changes", help="a change of configs/demo.yaml")
    parser.add_argument("--out", type=Path, help="keep all run directories and agreement.json in this new directory")
    parser.add_argument("--allow-busy", action="store_true", help="continue on a busy machine, and mark the runs")
    options = parser.parse_args()
    planned = plans(options.routes, options.conditions, options.repetitions, options.changes)
    results = []
    with TemporaryDirectory() as temporary:
        out = options.out or Path(temporary)
        print(HEAD)
        for runs in zip(*planned.values(), strict=True):
            by_kind: dict[str, Result] = {}
            for kind, run in zip(KINDS, runs, strict=True):
                busy = require_quiet(allow_busy=options.allow_busy) if kind == "real" else None
                by_kind[kind] = run_once(run, out / kind / run.name)
                print(result_row(kind, by_kind[kind], busy), flush=True)
            results.append(by_kind)
        rows = print_agreement(results)
        write_json(out / "agreement.json", rows)


if __name__ == "__main__":
    try:
        main()
    except LavtError as error:
        raise SystemExit(str(error)) from error
