"""The section of a report that compares the controllers of a sweep with the axis `controller.kind`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lavt.experiment.report import html_page
from lavt.experiment.report.condition_tables import JERK, STEERING_RATE
from lavt.experiment.report.files import save_table
from lavt.experiment.report.groups import short_name
from lavt.experiment.report.sections import Parts, ReportContext
from lavt.experiment.report.table_format import (
    TableData,
    extra,
    number_column,
    probability_column,
    share_column,
    share_interval_column,
    table_of_entries,
    text_column,
)
from lavt.experiment.statistics.controllers import PLACE, SUBJECT
from lavt.experiment.statistics.intervals import FEWEST_CLUSTERS

NOTE = (
    "Error, jerk, steering rate and speed are medians over all valid runs, completed or not. A controller that tracks "
    "well by shaking has a larger jerk and steering rate. The intervals are exact, for repeated runs of these routes."
)
TEST_NOTE = (
    f"Each test compares {SUBJECT} with the best of the other controllers at this place: the one with the most runs "
    "completed in their own lane and, of these, the smallest median error. A pair is two runs with the same route, "
    "repetition and seed. Completion in the own lane: McNemar's exact test, which takes the pairs as independent. "
    "Error: Wilcoxon's exact signed-rank test with the route as the unit, of the mean difference of P95 over the pairs "
    "that both controllers completed in their own lane; a negative difference is a smaller error of "
    f"{SUBJECT}. “Smallest p” is what so many routes can reach, before the correction. Holm's correction covers all "
    "tests of the same kind in this table. A route and its key part are on the same road and alike, so both tests are "
    f"for these routes only; a statement about other roads takes at least {FEWEST_CLUSTERS} roads."
)


def controller_parts(report: ReportContext) -> Parts:
    """Return the comparison of the controllers, and the tests; nothing unless a sweep varied the controller."""
    entries = report.summary.get("controllers") or []
    if not entries:
        return []
    parts = [
        save_table(report.directory, "controllers", controller_table(entries)),
        html_page.paragraph(NOTE, is_note=True),
    ]
    tests = tests_table(entries)
    if tests.rows:
        parts += [
            save_table(report.directory, "controller_tests", tests),
            html_page.paragraph(TEST_NOTE, is_note=True),
        ]
    return parts


def controller_table(entries: Sequence[Mapping[str, Any]]) -> TableData:
    """Return the table of controllers: one row for each controller at each place."""
    named, columns = _with_places(entries)
    return table_of_entries(
        named,
        [
            *columns,
            (text_column("controller"), "controller"),
            (number_column("runs", 0), "runs"),
            (number_column("completed in own lane", 0), "completed_in_own_lane"),
            (extra(share_column("share")), "own_lane_completion_rate"),
            (share_interval_column("95 %, these routes"), "own_lane_completion_interval"),
            (number_column("p95 m", 2), "p95_m"),
            (number_column(JERK, 2), "lateral_jerk_rms_mps3"),
            (number_column(STEERING_RATE, 3), "steering_rate_rms_radps"),
            (number_column("mean speed m/s", 1), "mean_speed_mps"),
        ],
    )


def tests_table(entries: Sequence[Mapping[str, Any]]) -> TableData:
    """Return the table of tests against the best baseline: one row for each place."""
    named, columns = _with_places([entry for entry in entries if entry["test"] is not None])
    return table_of_entries(
        named,
        [
            *columns,
            (text_column("best baseline"), "test.baseline"),
            (number_column("pairs", 0), "test.pairs"),
            (number_column(f"completed by {SUBJECT} only", 0), "test.only_subject"),
            (number_column("completed by the baseline only", 0), "test.only_baseline"),
            (extra(probability_column("p of completion")), "test.p_completion"),
            (probability_column("p of completion, Holm"), "test.p_completion_holm"),
            (extra(number_column("pairs completed by both", 0)), "test.error_pairs"),
            (number_column("routes", 0), "test.routes"),
            (extra(number_column("roads", 0)), "test.roads"),
            (number_column("difference of p95 m, median of routes", 2), "test.p95_difference_m"),
            (probability_column("p of error"), "test.p_error"),
            (probability_column("smallest p of error"), "test.smallest_p_error"),
            (probability_column("p of error, Holm"), "test.p_error_holm"),
        ],
    )


def _with_places(entries: Sequence[Mapping[str, Any]]) -> tuple[list[dict[str, Any]], list[tuple[Any, str]]]:
    """Return the entries with their place as columns, and these columns: the condition, and what differs."""
    axes = list(dict.fromkeys(name for entry in entries for name in entry["axes"]))
    differing = [name for name in PLACE if name != "condition" and len({str(entry.get(name)) for entry in entries}) > 1]
    keys = {name: f"place_{number}" for number, name in enumerate([*differing, *axes])}
    named = [
        {
            **entry,
            **{key: _text(entry["axes"][name] if name in axes else entry.get(name)) for name, key in keys.items()},
        }
        for entry in entries
    ]
    columns = [(text_column(short_name(name)), key) for name, key in keys.items()]
    return named, [(text_column("condition"), "condition"), *columns]


def _text(value: Any) -> str | None:
    return None if value is None else str(value)
