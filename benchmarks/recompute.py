"""Recompute the results of a sweep or a run from its records alone, and compare them with LAVT's.

    python benchmarks/recompute.py out/paper

This program and its modules in `recomputing` import nothing of LAVT: they were written from `docs/metrics.md` and
`docs/records.md`, with `mcap`, `numpy` and `scipy`. From `result.json` they take only what the records do not have: the
identity of the run and its validity. The program prints the headline table, and each value of `result.json` and
`summary.json` that differs by more than rounding. The exit code is 1 if there is any. It covers sweeps in virtual time
without further axes, and single runs, also of a person, whose clocks are those of one kernel or have time sources. It
does not recompute the stages, the bound and drift of the clock offset, the validity, survival, and the groups.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.recomputing.conditions import common, contrasts, groups, summarize
from benchmarks.recomputing.runs import recompute_run

Row = dict[str, Any]

IDENTITY = ("run", "route", "condition", "repetition", "seed", "participant", "block", "valid")

TOLERANCE = 1e-9
"""Relative and absolute. Sums in another order differ by less; a time that is rounded to another ns differs by more."""

HEADLINE = ("runs", "completion_rate", "own_lane_completion_rate", "collisions_per_run", "p95_route_balanced_m")


def differences(name: str, recomputed: Any, published: Any) -> Iterator[str]:
    """Return a text for each recomputed value that is not the published one."""
    if isinstance(recomputed, dict) and isinstance(published, dict):
        for key, value in recomputed.items():
            yield from differences(f"{name}.{key}", value, published.get(key, "missing"))
    elif isinstance(recomputed, list | tuple) and isinstance(published, list) and len(recomputed) == len(published):
        for index, (value, other) in enumerate(zip(recomputed, published, strict=True)):
            yield from differences(f"{name}[{index}]", value, other)
    elif not _is_equal(recomputed, published):
        yield f"{name}: recomputed {recomputed}, published {published}"


def _is_equal(recomputed: Any, published: Any) -> bool:
    if isinstance(recomputed, bool | str) or recomputed is None or not isinstance(published, int | float):
        return bool(recomputed == published)
    return math.isclose(recomputed, published, rel_tol=TOLERANCE, abs_tol=TOLERANCE)


def count_values(value: Any) -> int:
    """Return the number of single values in nested mappings and lists."""
    if isinstance(value, dict | list | tuple):
        return sum(map(count_values, value.values() if isinstance(value, dict) else value))
    return 1


def recompute_sweep(directory: Path) -> tuple[dict[str, Row], list[str], int]:
    """Return the recomputed conditions, a text for each difference, and the number of compared values."""
    summary = json.loads((directory / "summary.json").read_text())
    runs: list[Row] = []
    found: list[str] = []
    compared = 0
    for result_file in sorted(directory.glob("runs/*/result.json")):
        published = json.loads(result_file.read_text())
        if published["time"] != "virtual" or published.get("axes"):
            raise SystemExit(f"{result_file} is not of a run in virtual time without axes")
        values = recompute_run(result_file.parent)
        found += differences(str(published["run"]), values, published)
        compared += count_values(values)
        runs.append({**values, **{key: published[key] for key in IDENTITY}})
    valid = [run for run in runs if run["valid"]]
    common_p95 = common(valid)
    conditions = {
        name: summarize(of_condition, common_p95)
        for name, of_condition in groups(valid, lambda run: run["condition"]).items()
    }
    recomputed = {"conditions": conditions, "contrasts": contrasts(valid)}
    found += differences("summary", recomputed, summary)
    return conditions, found, compared + count_values(recomputed)


def recompute_one(directory: Path) -> tuple[dict[str, Row], list[str], int]:
    """Return no conditions, a text for each difference, and the number of compared values of a single run."""
    values = recompute_run(directory)
    found = differences("run", values, json.loads((directory / "result.json").read_text()))
    return {}, list(found), count_values(values)


def print_table(conditions: dict[str, Row]) -> None:
    """Print the headline as a Markdown table."""
    print("| | " + " | ".join(HEADLINE) + " |")
    print("|---" * (len(HEADLINE) + 1) + "|")
    for name, entry in conditions.items():
        cells = ["null" if entry[key] is None else f"{entry[key]:.4g}" for key in HEADLINE]
        print(f"| {name} | " + " | ".join(cells) + " |")


def main(arguments: Sequence[str]) -> int:
    """Recompute the sweep or the run in the named directory; return 1 if a value differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path, help="directory of a sweep, or of a run")
    directory = parser.parse_args(arguments).directory
    recompute = recompute_one if (directory / "result.json").is_file() else recompute_sweep
    conditions, found, compared = recompute(directory)
    if conditions:
        print_table(conditions)
    print(f"{compared} values were recomputed; {len(found)} differ by more than rounding")
    print("\n".join(found))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
