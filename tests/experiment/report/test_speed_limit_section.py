from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lavt.experiment.report.sections import ReportContext
from lavt.experiment.report.speed_limit_section import speed_limit_parts, speed_limit_table


def run_with(reasons_s: dict[str, float], mean_mps: float, **changes: Any) -> dict[str, Any]:
    """Return an entry of a run in which each reason limited the speed for the given time."""
    total_s = sum(reasons_s.values())
    reasons = {name: {"time_s": time_s, "share": time_s / total_s} for name, time_s in reasons_s.items()}
    limits = {"time_s": total_s, "lowest_mps": mean_mps - 1, "mean_mps": mean_mps, "reasons": reasons}
    return {"valid": True, "time": "virtual", "condition": "L5", "speed_limits": limits, **changes}


def test_reasons_are_weighted_by_time() -> None:
    """A row has all valid runs of a condition: the mean limit and the shares are weighted by time."""
    runs = [
        run_with({"latency": 30.0}, 5.0),
        run_with({"latency": 5.0, "recovery": 5.0}, 9.0),
        run_with({"speed": 99.0}, 9.0, valid=False),
        {"valid": True, "time": "virtual", "condition": "L5", "speed_limits": None},
        run_with({"stopping distance": 1.0}, 10.0, condition="L0"),
    ]
    table = speed_limit_table(runs)
    cells = {column.title: [row[index] for row in table.rows] for index, column in enumerate(table.columns)}
    assert (cells["condition"], cells["runs"]) == (["L0", "L5"], [1, 2])
    assert cells["limit, mean km/h"] == pytest.approx([36.0, 6.0 * 3.6])
    assert cells["limit, lowest km/h"] == pytest.approx([9.0 * 3.6, 4.0 * 3.6])
    assert cells["latency"] == pytest.approx([0.0, 0.875])
    assert cells["recovery"] == pytest.approx([0.0, 0.125])
    assert cells["stopping distance"] == pytest.approx([1.0, 0.0])


def test_without_a_governor_there_is_no_section(tmp_path: Path) -> None:
    """The section is empty if no valid run has a speed governor, also for results of an older version."""
    older = {"valid": True, "time": "virtual", "condition": "L5"}
    assert speed_limit_parts(ReportContext({"runs": [older, {**older, "speed_limits": None}]}, tmp_path, {})) == []


def test_the_table_is_a_file_of_the_report(tmp_path: Path) -> None:
    """The section has a sentence and a table, whose numbers are also in a CSV file."""
    parts = speed_limit_parts(ReportContext({"runs": [run_with({"latency": 30.0}, 5.0)]}, tmp_path, {}))
    assert len(parts) == 2
    head, row = (tmp_path / "tables" / "speed_limits.csv").read_text().splitlines()
    assert head.startswith("time,condition,runs")
    assert row.startswith("virtual,L5,1")
