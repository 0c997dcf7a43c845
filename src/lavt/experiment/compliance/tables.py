"""The tables of the compliance report, from the content of `compliance.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lavt.experiment.compliance.criteria import CRITERIA
from lavt.experiment.report.table_format import (
    LOW_HIGH,
    NOTHING,
    SHARE,
    UNBROKEN,
    Column,
    TableData,
    extra,
    number_column,
    share_interval_column,
    table_of_entries,
    text_column,
)

Content = Mapping[str, Any]
"""The content of `compliance.json`."""


def format_bounds(bounds: Sequence[float | None] | None, *, digits: int = 1, scale: float = 1.0) -> str:
    """Return a number if both bounds are shown alike, otherwise "low to high", or "at least low" without a high one."""
    if bounds is None or bounds[0] is None:
        return NOTHING
    low = f"{bounds[0] * scale:.{digits}f}"
    if bounds[1] is None:
        return f"at least {low}".replace(" ", UNBROKEN)
    high = f"{bounds[1] * scale:.{digits}f}"
    return low if low == high else f"{low} to {high}".replace(" ", UNBROKEN)


def format_share(bounds: Sequence[float | None] | None) -> str:
    """Return the bounds of a share in per cent; a share that is not 0 never looks like 0, nor one below 1 like 1."""
    if bounds is None:
        return NOTHING
    known = [bound for bound in bounds if bound is not None]
    digits = next(
        (digits for digits in (1, 2, 3) if all(_is_shown(bound, digits) for bound in known)),
        4,
    )
    return f"{format_bounds(bounds, digits=digits, scale=100.0)}{UNBROKEN}%"


def _is_shown(share: float, digits: int) -> bool:
    return (share in (0, 1)) or 0 < float(f"{share * 100:.{digits}f}") < 100


def bounds_column(title: str, *, digits: int = 1) -> Column:
    """Return a column of bounds."""
    return Column(title, lambda cell: format_bounds(cell, digits=digits), LOW_HIGH)


def share_bounds_column(title: str) -> Column:
    """Return a column of bounds of a share."""
    return Column(title, format_share, LOW_HIGH, csv_unit=SHARE)


def drive_table(content: Content) -> TableData:
    """Return the table with a row for each drive that counts, for the page."""
    return table_of_entries(content["drives"], _drive_columns(content["limit_ms"]))


def csv_table(content: Content) -> TableData:
    """Return the table with a row for each drive that counts, and for each excluded one with the reason; for CSV."""
    columns = [
        *_drive_columns(content["limit_ms"]),
        *((text_column(f"verdict {key}"), f"verdicts.{key}") for key in CRITERIA),
        (text_column("directory"), "directory"),
        (text_column("excluded because"), "reason"),
    ]
    entries = [*content["drives"], *content["excluded"]]
    rows = [[_value(entry, key) for _, key in columns] for entry in entries]
    return TableData([column for column, _ in columns], rows)


def _value(entry: Mapping[str, Any], key: str) -> Any:
    value: Any = entry
    for name in key.split("."):
        value = (value or {}).get(name)
    return value


def _drive_columns(limit_ms: float) -> list[tuple[Column, str]]:
    limit = f"{limit_ms:g} ms"
    return [
        (text_column("run"), "run"),
        (text_column("verdict"), "verdict"),
        (share_bounds_column(f"frame age above {limit}"), "above_share"),
        (bounds_column("longest stretch above s", digits=2), "longest_above_s"),
        (extra(number_column("it began at s", 2)), "longest_above_began_s"),
        (extra(text_column("it began at (UTC)")), "longest_above_began"),
        (bounds_column("frame age p95 ms"), "picture_age_ms.p95"),
        (extra(bounds_column("frame age p50 ms")), "picture_age_ms.p50"),
        (extra(bounds_column("frame age max ms")), "picture_age_ms.max"),
        (extra(text_column("age counts from")), "age_from"),
        (share_bounds_column(f"two-way latency above {limit}"), "two_way_above_share"),
        (bounds_column("two-way p95 ms"), "two_way_ms.p95"),
        (extra(bounds_column("two-way p50 ms")), "two_way_ms.p50"),
        (extra(bounds_column("two-way max ms")), "two_way_ms.max"),
        (number_column("outages", 0), "outages"),
        (extra(number_column("all outages s", 2)), "outage_s"),
        (number_column("longest outage s", 2), "longest_outage_s"),
        (extra(number_column("degraded s", 2)), "degraded_s"),
        (number_column("minimal-risk manoeuvres", 0), "manoeuvres"),
        (bounds_column("longest manoeuvre s", digits=2), "longest_manoeuvre_s"),
        (extra(number_column("driver overrides", 0)), "driver_overrides"),
        (share_bounds_column("faster than allowed"), "too_fast_share"),
        (bounds_column("blind distance p95 m", digits=2), "blind_distance_m.p95"),
        (bounds_column("blind distance max m", digits=2), "blind_distance_m.max"),
        (extra(number_column("blind distance limit m", 2)), "blind_distance_m.limit"),
        (extra(number_column("nominal speed km/h")), "nominal_kmh"),
        (extra(text_column("speed is")), "speed_source"),
        (number_column("commanded time s"), "commanded_s"),
        (extra(bounds_column("distance m")), "distance_m"),
        (extra(text_column("ending")), "ending"),
        (extra(text_column("time")), "time"),
        (extra(text_column("fidelity")), "fidelity"),
        (extra(text_column("route")), "route"),
        (extra(text_column("condition")), "condition"),
        (extra(text_column("driver")), "driver"),
        (extra(text_column("began (UTC)")), "began"),
        (extra(number_column("drives in the record", 0)), "drives_in_record"),
    ]


def criteria_table(content: Content) -> TableData:
    """Return the table with a row for each criterion: threshold, value, and how many drives are within or above it.

    Of several drives, the value is the largest one; of a single drive, the table has its verdict.
    """
    everything = content["fleet"][0]
    is_fleet = everything["drives"] > 1
    columns = [
        text_column("criterion"),
        Column("at most", _format_quantity, ("threshold", "unit")),
        Column("largest value" if is_fleet else "value", _format_quantity, ("low", "high", "unit")),
        *(number_column(title, 0) for title in ("drives within", "drives above", "not decided")),
        share_interval_column("drives above, 95 % interval"),
        text_column("verdict"),
    ]
    rows = []
    for key, criterion in CRITERIA.items():
        counts, threshold = everything["verdicts"][key], content["thresholds"][key]
        low, high = counts["largest"]
        numbers = [counts[name] if is_fleet else None for name in ("within", "above", "not_decided", "above_interval")]
        verdict = None if is_fleet else content["drives"][0]["verdicts"][key]
        value = {"low": low, "high": high, "unit": criterion.unit}
        rows.append([criterion.title, {"threshold": threshold, "unit": criterion.unit}, value, *numbers, verdict])
    return TableData(columns, rows).without_empty_columns()


def _format_quantity(cell: Mapping[str, Any]) -> str:
    """Return a threshold, or the bounds of a value, with its unit."""
    bounds = (cell["threshold"], cell["threshold"]) if "threshold" in cell else (cell["low"], cell["high"])
    if cell["unit"] == SHARE:
        return format_share(bounds)
    digits = 0 if all(bound is None or bound == int(bound) for bound in bounds) else 2
    return f"{format_bounds(bounds, digits=digits)} {cell['unit']}".strip().replace(" ", UNBROKEN)


def totals_table(content: Content) -> TableData:
    """Return the table with a row for all drives together, and one for each group of drives."""
    limit = f"{content['limit_ms']:g} ms"
    mean = "mean_above_share_per_drive.interval"
    return table_of_entries(
        content["fleet"],
        [
            (text_column("drives"), "group"),
            (number_column("number", 0), "drives"),
            (number_column("drives above", 0), "verdict.above"),
            (extra(number_column("not decided", 0)), "verdict.not_decided"),
            (share_interval_column("drives above, 95 % interval"), "verdict.above_interval"),
            (share_bounds_column(f"frame age above {limit}"), "above_share"),
            (share_interval_column("mean of the drives, 95 % interval"), mean),
            (bounds_column("longest stretch above s", digits=2), "longest_above_s"),
            (share_bounds_column(f"two-way latency above {limit}"), "two_way_above_share"),
            (number_column("outages", 0), "outages"),
            (extra(number_column("all outages s", 2)), "outage_s"),
            (extra(number_column("longest outage s", 2)), "longest_outage_s"),
            (number_column("minimal-risk manoeuvres", 0), "manoeuvres"),
            (bounds_column("longest manoeuvre s", digits=2), "longest_manoeuvre_s"),
            (share_bounds_column("faster than allowed"), "too_fast_share"),
            (number_column("commanded time s"), "commanded_s"),
        ],
    )


def manoeuvre_table(content: Content) -> TableData:
    """Return the table with a row for each minimal-risk manoeuvre."""
    entries = [{**stop, "run": drive["run"]} for drive in content["drives"] for stop in drive["manoeuvre_list"]]
    return table_of_entries(
        entries,
        [
            (text_column("run"), "run"),
            (number_column("began at s", 2), "began_s"),
            (Column("manoeuvre", lambda cell: str(cell).replace("_", " "), is_text=True), "kind"),
            (text_column("reason", is_long=True), "reason"),
            (number_column("speed km/h"), "speed_kmh"),
            (bounds_column("until standstill s", digits=2), "until_standstill_s"),
            (bounds_column("distance m"), "distance_m"),
            (text_column("ended by"), "ended"),
        ],
    )


def outage_table(content: Content) -> TableData:
    """Return the table with a row for each outage."""
    entries = [{**outage, "run": drive["run"]} for drive in content["drives"] for outage in drive["outage_list"]]
    columns = [
        (text_column("run"), "run"),
        (number_column("began at s", 2), "began_s"),
        (number_column("length s", 2), "length_s"),
    ]
    return table_of_entries(entries, columns)


def excluded_table(content: Content) -> TableData:
    """Return the table of the drives that do not count, with the reasons."""
    columns = [(text_column("run"), "run"), (text_column("reason", is_long=True), "reason")]
    return table_of_entries(content["excluded"], columns)
