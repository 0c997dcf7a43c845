"""Print the comparison of the controllers of sweeps in Markdown, as the report of `lavt report` has it.

    python -m benchmarks.compare_controllers OUT [OUT ...] [--all-columns]

The program reads the results of one or more sweeps with the axis `controller.kind`. Sweeps of several directories are
compared together, so that a sweep can supply a baseline that another one lacks. Results of an older version have no
lateral jerk; `lavt report OUT` computes them again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lavt.experiment.analysis.results import read_json
from lavt.experiment.report.controller_section import controller_table, tests_table
from lavt.experiment.report.table_format import UNBROKEN, TableData
from lavt.experiment.statistics.controllers import compare_controllers


def read_runs(sweeps: Iterable[Path]) -> list[dict[str, Any]]:
    """Return the results of all runs, sorted by path."""
    return [read_json(path) for sweep in sweeps for path in sorted(sweep.rglob("result.json"))]


def markdown_of(table: TableData, *, all_columns: bool) -> str:
    """Return a table in Markdown, without the columns that the page shows only on demand."""
    shown = [index for index, column in enumerate(table.columns) if all_columns or not column.is_extra]
    columns = [table.columns[index] for index in shown]
    lines = [[column.title for column in columns], ["---"] * len(columns)]
    lines += [[column.show(row[index]) for index, column in zip(shown, columns, strict=True)] for row in table.rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace(UNBROKEN, " ")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweeps", type=Path, nargs="+")
    parser.add_argument("--all-columns", action="store_true")
    options = parser.parse_args()
    entries = compare_controllers(read_runs(options.sweeps))
    if not entries:
        raise SystemExit("no sweep varied the controller: name the directories of sweeps with the axis controller.kind")
    for table in (controller_table(entries), tests_table(entries)):
        print(markdown_of(table, all_columns=options.all_columns), end="\n\n")


if __name__ == "__main__":
    main()
