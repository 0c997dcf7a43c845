"""The section of a report on how the speed governor limited the speed of the vehicles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lavt.experiment.report import html_page
from lavt.experiment.report.files import save_table
from lavt.experiment.report.sections import Parts, ReportContext
from lavt.experiment.report.table_format import TableData, number_column, share_column, text_column
from lavt.safety.speed_limit import SPEED_LIMIT_REASONS

KMPH = 3.6


def speed_limit_parts(report: ReportContext) -> Parts:
    """Return the table of speed limits by condition; nothing if no valid run has a speed governor."""
    table = speed_limit_table(report.summary["runs"])
    if not table.rows:
        return []
    text = (
        "The valid runs in which the vehicle had a speed governor: its limit, and the share of the time for which each "
        "reason limited the speed. docs/governor.md explains the reasons."
    )
    return [html_page.paragraph(text), save_table(report.directory, "speed_limits", table)]


def speed_limit_table(runs: Sequence[Mapping[str, Any]]) -> TableData:
    """Return the table of speed limits: a row for each kind of time and condition, with all its valid runs."""
    governed: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for run in runs:
        if run["valid"] and run.get("speed_limits"):
            governed.setdefault((str(run["time"]), str(run["condition"])), []).append(run["speed_limits"])
    columns = [
        text_column("time"),
        text_column("condition"),
        number_column("runs", 0),
        number_column("limit, mean km/h"),
        number_column("limit, lowest km/h"),
        *(share_column(reason) for reason in SPEED_LIMIT_REASONS),
    ]
    rows: list[list[Any]] = []
    for (time, condition), entries in sorted(governed.items()):
        total_s = sum(entry["time_s"] for entry in entries)
        if not total_s:
            continue
        mean_mps = sum((entry["mean_mps"] or 0.0) * entry["time_s"] for entry in entries) / total_s
        lowest_mps = min(entry["lowest_mps"] for entry in entries)
        shares = [
            sum(entry["reasons"].get(reason, {"time_s": 0.0})["time_s"] for entry in entries) / total_s
            for reason in SPEED_LIMIT_REASONS
        ]
        rows.append([time, condition, len(entries), mean_mps * KMPH, lowest_mps * KMPH, *shares])
    return TableData(columns, rows)
