"""One drive, evaluated from its records: every number of its row in the compliance report, with bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lavt.clock import calendar_time
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import WorkError
from lavt.experiment.analysis.clocks import wall_ns_at
from lavt.experiment.analysis.metrics import driving_interval
from lavt.experiment.compliance.commands_in_force import commands_in_force
from lavt.experiment.compliance.criteria import CRITERIA, ComplianceLimits, as_bounds, verdict_of, worst_of
from lavt.experiment.compliance.ramps import Interval, Ramps, longest
from lavt.experiment.compliance.speeds import SpeedReports, blind_distance, excess, speed_reports
from lavt.experiment.compliance.stops import (
    COMMANDED,
    Manoeuvre,
    manoeuvres,
    outages,
    state_changes,
    time_in,
)
from lavt.recording.record import Record
from lavt.recording.table import Table
from lavt.safety.limits import LIMITS

SERVER_CHANNELS = ("frame", "admission", "event", "truth", "state", "clock")
IDENTITY = ("run", "time", "fidelity", "route", "condition", "changes", "driver")
NOTHING_DRIVEN = "the vehicle was never commanded: the drive has no length"


@dataclass(frozen=True, slots=True)
class DriveCompliance:
    """The compliance of one drive. `entry` is its row; the rest is what figures draw. Times are ns since its start.

    Each pair is a lower and an upper bound: of the frame age and of the two-way latency in ns, in the commanded time.
    """

    directory: Path
    entry: Mapping[str, Any]
    age_ns: tuple[Ramps, Ramps]
    two_way_ns: tuple[Ramps, Ramps]
    speeds: SpeedReports
    outages: Sequence[Interval]
    manoeuvres: Sequence[Manoeuvre]
    duration_ns: float


def evaluate_drive(
    directory: Path,
    identity: Mapping[str, Any],
    server: Record,
    page_pictures: Table | None,
    limits: ComplianceLimits,
) -> DriveCompliance:
    """Return the compliance of the drive in the server's record.

    `identity` has the keys of `IDENTITY` from `result.json`. `page_pictures` is None if no person drives. If `limits`
    has no nominal speed, it is the default speed limit. Raises `WorkError` if nothing was driven.
    """
    began_ns, ended_ns, ending = driving_interval(server)
    if began_ns > ended_ns:
        raise WorkError("the record has no drive: the vehicle was never armed")
    duration_ns = float(ended_ns - began_ns)
    changes = state_changes(server.table("event"), (began_ns, ended_ns))
    commanded = time_in(COMMANDED, changes, duration_ns)
    if not commanded:
        raise WorkError(NOTHING_DRIVEN)
    camera_ns = None if limits.camera_ms is None else round(limits.camera_ms * NS_PER_MS)
    commands = commands_in_force(
        server.table("frame"), server.table("admission"), page_pictures, (began_ns, ended_ns), camera_ns
    )
    speeds = speed_reports(server, began_ns)
    gaps = outages(commands.fresh_ns, commanded, limits.outage_ms * NS_PER_MS)
    stops = manoeuvres(changes, speeds)
    age_ns, two_way_ns = (_within(pair, commanded) for pair in (commands.frame_age(), commands.two_way_latency(gaps)))
    degraded = time_in(("degraded",), changes, duration_ns)
    total_s = sum(end - begin for begin, end in commanded) / NS_PER_S
    latency = _latency_entry(age_ns, two_way_ns, limits.latency_ms * NS_PER_MS, total_s)
    began_s = latency["longest_above_began_s"]
    entry: dict[str, Any] = {
        **{key: identity.get(key) for key in IDENTITY},
        "ending": ending,
        "began": _moment(server, began_ns, identity),
        "drives_in_record": server.table("event").texts("kind").count("drive_began"),
        "duration_s": duration_ns / NS_PER_S,
        "commanded_s": total_s,
        "distance_m": speeds.distance_m(0.0, duration_ns),
        "age_from": "capture" if commands.is_from_capture else "stamp",
        **latency,
        "longest_above_began": None if began_s is None else _moment(server, began_ns, identity, began_s),
        **_stop_entry(gaps, stops),
        "degraded_s": sum(end - begin for begin, end in degraded) / NS_PER_S,
        "driver_overrides": sum(change.after == "disarmed" for change in changes),
        **_speed_entry(age_ns, speeds, limits, total_s),
    }
    verdicts = {key: verdict_of(as_bounds(entry[key]), limits.threshold(key)) for key in CRITERIA}
    entry |= {"verdicts": verdicts, "verdict": worst_of(list(verdicts.values()))}
    return DriveCompliance(directory, entry, age_ns, two_way_ns, speeds, gaps, stops, duration_ns)


def _latency_entry(
    age_ns: tuple[Ramps, Ramps], two_way_ns: tuple[Ramps, Ramps], limit_ns: float, total_s: float
) -> dict[str, Any]:
    return {
        "picture_age_ms": _spread(age_ns, NS_PER_MS),
        "above_s": _time_above(age_ns, limit_ns),
        "above_share": _share_above(age_ns, limit_ns, total_s),
        **_longest(age_ns, limit_ns),
        "two_way_ms": _spread(two_way_ns, NS_PER_MS),
        "two_way_above_share": _share_above(two_way_ns, limit_ns, total_s),
    }


def _stop_entry(gaps: Sequence[Interval], stops: Sequence[Manoeuvre]) -> dict[str, Any]:
    lengths_s = [(end - begin) / NS_PER_S for begin, end in gaps]
    return {
        "outages": len(gaps),
        "outage_s": sum(lengths_s),
        "longest_outage_s": max(lengths_s, default=0.0),
        "outage_list": [_interval_entry(gap) for gap in gaps],
        "manoeuvres": len(stops),
        "longest_manoeuvre_s": _longest_manoeuvre(stops),
        "manoeuvre_list": [_manoeuvre_entry(stop) for stop in stops],
    }


def _speed_entry(
    age_ns: tuple[Ramps, Ramps], speeds: SpeedReports, limits: ComplianceLimits, total_s: float
) -> dict[str, Any]:
    nominal_mps = limits.nominal_mps or LIMITS.speed_limit_mps
    blind_limit_m = nominal_mps * limits.latency_ms / 1000
    blind_m = blind_distance(age_ns, speeds)
    too_fast = excess(blind_m, speeds, nominal_mps)
    return {
        "speed_source": speeds.source,
        "nominal_kmh": nominal_mps * 3.6,
        "blind_distance_m": {**_spread(blind_m, 1.0), "limit": blind_limit_m},
        "too_fast_s": _time_above(too_fast, blind_limit_m),
        "too_fast_share": _share_above(too_fast, blind_limit_m, total_s),
    }


def _within(bounds: tuple[Ramps, Ramps], intervals: Sequence[Interval]) -> tuple[Ramps, Ramps]:
    return bounds[0].within(intervals), bounds[1].within(intervals)


def _time_above(bounds: tuple[Ramps, Ramps], limit: float) -> tuple[float, float]:
    return bounds[0].time_above(limit) / NS_PER_S, bounds[1].time_above(limit) / NS_PER_S


def _share_above(bounds: tuple[Ramps, Ramps], limit: float, total_s: float) -> tuple[float, float]:
    low_s, high_s = _time_above(bounds, limit)
    return min(low_s / total_s, 1.0), min(high_s / total_s, 1.0)


def _spread(bounds: tuple[Ramps, Ramps], unit: float) -> dict[str, tuple[float, float]]:
    """Return the bounds of median, 95th percentile and maximum."""
    spread = {}
    for name, share in (("p50", 0.5), ("p95", 0.95), ("max", 1.0)):
        low, high = (ramps.maximum if share == 1.0 else ramps.percentile(share) for ramps in bounds)
        spread[name] = ((low or 0.0) / unit, (np.inf if high is None else high) / unit)
    return spread


def _longest(bounds: tuple[Ramps, Ramps], limit: float) -> dict[str, Any]:
    """Return the bounds of the longest stretch above the limit, and when it began: that of the lower bound, if any."""
    stretches = [longest(ramps.stretches_above(limit)) for ramps in bounds]
    low_s, high_s = (0.0 if stretch is None else (stretch[1] - stretch[0]) / NS_PER_S for stretch in stretches)
    shown = stretches[0] or stretches[1]
    return {
        "longest_above_s": (low_s, high_s),
        "longest_above_began_s": None if shown is None else shown[0] / NS_PER_S,
    }


def _longest_manoeuvre(stops: Sequence[Manoeuvre]) -> tuple[float, float]:
    lengths = [_length_s(stop) for stop in stops]
    return max((low for low, _ in lengths), default=0.0), max((high for _, high in lengths), default=0.0)


def _length_s(stop: Manoeuvre) -> tuple[float, float]:
    """Return the bounds of the time until standstill; without standstill, it has no upper bound."""
    if stop.standstill_ns is None:
        return (stop.end_ns - stop.begin_ns) / NS_PER_S, np.inf
    low_ns, high_ns = stop.standstill_ns
    return (low_ns - stop.begin_ns) / NS_PER_S, (high_ns - stop.begin_ns) / NS_PER_S


def _manoeuvre_entry(stop: Manoeuvre) -> dict[str, Any]:
    return {
        "began_s": stop.begin_ns / NS_PER_S,
        "kind": stop.kind,
        "reason": stop.reason,
        "speed_kmh": None if stop.speed_mps is None else stop.speed_mps * 3.6,
        "until_standstill_s": _length_s(stop),
        "distance_m": stop.distance_m,
        "ended": "driver override" if stop.is_taken_over else "standstill" if stop.standstill_ns else "not recorded",
    }


def _interval_entry(interval: Interval) -> dict[str, float]:
    begin_ns, end_ns = interval
    return {"began_s": begin_ns / NS_PER_S, "length_s": (end_ns - begin_ns) / NS_PER_S}


def _moment(server: Record, began_ns: int, identity: Mapping[str, Any], after_s: float = 0.0) -> str | None:
    """Return a moment of the drive by the server's wall clock as ISO 8601 in UTC; None in virtual time."""
    if identity.get("time") != "real":
        return None
    return calendar_time(wall_ns_at(server, began_ns + round(after_s * NS_PER_S))).isoformat()
