"""The measurements in `result.json`, computed only from the two records of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clocks import RunClocks, run_clocks
from lavt.experiment.analysis.comfort import comfort_metrics
from lavt.experiment.analysis.lane_kept import completed_in_own_lane, lane_kept
from lavt.experiment.analysis.latency import (
    ages_at_actuation_ns,
    control_latency_ns,
    decoded_frames,
    frame_age,
    frames_with_commands,
    frames_within,
    latency_sum_error_ns,
    page_latency_ns,
    page_pictures_of,
    percentiles_ms,
    received_frames_of,
    video_latency_ns,
)
from lavt.experiment.analysis.speed_limits import speed_limit_metrics
from lavt.experiment.analysis.stage_latency import processing_ns, stage_percentiles
from lavt.experiment.analysis.steering import steering_metrics
from lavt.experiment.analysis.tracking import (
    cross_track_metrics,
    distance_m,
    heading_metrics,
    p95_by_10m,
    per_km,
    route_length_m,
)
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table


@dataclass(frozen=True, slots=True)
class RunMeasurement:
    """The measurements of a run.

    `entry` has the keys of `result.json` from `ending` on. `closure_p95_ms` is the closure: the 95th percentile of the
    absolute difference between the sum of the loop's parts and the loop latency; None: unknown.
    """

    entry: Mapping[str, Any]
    closure_p95_ms: float | None
    clocks: RunClocks


def driving_interval(server: Record) -> tuple[int, int, str | None]:
    """Return start and end of the drive on the server's monotonic clock, and its ending.

    Without an event `drive_began` the interval is empty. Without an event `ending`, as after a crash, the interval ends
    with the last message of the record, and the ending is None.
    """
    began_ns: int | None = None
    ended_ns, ending = server.last_ns, None
    for kind, mono_ns, detail in _events(server.table("event")):
        if kind == "drive_began" and began_ns is None:
            began_ns = mono_ns
        if kind == "ending" and began_ns is not None and ending is None:
            ended_ns, ending = mono_ns, detail
    return (ended_ns + 1 if began_ns is None else began_ns), ended_ns, ending


def _events(events: Table) -> list[tuple[str, int, str]]:
    return list(zip(events.texts("kind"), events.ints("mono_ns").tolist(), events.texts("detail"), strict=True))


def measure(server: Record, client: Record) -> RunMeasurement:
    """Compute every metric of a run.

    Metrics for which the records have no data (ground truth, clock samples or received frames) are None.
    """
    began_ns, ended_ns, ending = driving_interval(server)
    has_begun = began_ns <= ended_ns
    clocks = run_clocks(server, client, began_ns, ended_ns)
    truth, route, frames = (server.table(name) for name in ("truth", "route", "frame"))
    kept = lane_kept(truth, route, frames, client.table("lane"), (began_ns, ended_ns))
    latencies, closure_p95_ms = _latencies(server, client, began_ns, ended_ns, clocks)
    entry = {
        "ending": ending,
        **_tracking(server, began_ns, ended_ns),
        "completed_in_own_lane": completed_in_own_lane(ending, kept["lane_kept"]),
        **kept,
        "duration_s": (ended_ns - began_ns) / NS_PER_S if has_begun else None,
        "speed_limits": speed_limit_metrics(server.table("speed_limit"), began_ns, ended_ns),
        **latencies,
        "delta": clocks.entry,
    }
    return RunMeasurement(entry, closure_p95_ms, clocks)


def _tracking(server: Record, began_ns: int, ended_ns: int) -> dict[str, Any]:
    truth = server.table("truth")
    truth_ns = truth.ints("mono_ns")
    truth = truth.where((truth_ns >= began_ns) & (truth_ns <= ended_ns))
    kinds = [kind for kind, mono_ns, _ in _events(server.table("event")) if began_ns <= mono_ns <= ended_ns]
    driven_m, collisions, invasions = distance_m(truth), kinds.count("collision"), kinds.count("lane_invasion")
    return {
        "route_length_m": route_length_m(server.table("route")),
        "distance_m": driven_m,
        **cross_track_metrics(truth),
        "p95_by_10m": p95_by_10m(truth),
        **heading_metrics(truth),
        **steering_metrics(truth),
        **comfort_metrics(truth),
        "collisions": collisions,
        "lane_invasions": invasions,
        "collisions_per_km": per_km(collisions, driven_m),
        "lane_invasions_per_km": per_km(invasions, driven_m),
    }


def _latencies(
    server: Record, client: Record, began_ns: int, ended_ns: int, clocks: RunClocks
) -> tuple[dict[str, Any], float | None]:
    all_frames, command_verdicts = server.table("frame"), server.table("admission")
    frames = frames_within(all_frames, began_ns, ended_ns)
    decoded = decoded_frames(received_frames_of(client.table("picture"), frames))
    paired = frames_with_commands(frames, command_verdicts, ended_ns)
    age = frame_age(all_frames, command_verdicts, began_ns, ended_ns)
    no_times = np.zeros(0, np.int64)
    tau_v_ns, tau_c_ns, bound_ms, closure_p95_ms = no_times, no_times, clocks.bound_ms, None
    if clocks.offset is not None:
        tau_v_ns = video_latency_ns(decoded, clocks.offset)
        tau_c_ns = control_latency_ns(command_verdicts, clocks.offset, began_ns, ended_ns)
        errors_ns = latency_sum_error_ns(decoded, paired, clocks.offset)
        if len(errors_ns):
            closure_p95_ms = float(np.percentile(np.abs(errors_ns), 95)) / NS_PER_MS
    entry = {
        "loop_ms": percentiles_ms(paired.loop_ns),
        "picture_age_ms": {"mean": age.mean_ms, "p95": age.p95_ms},
        "loop_jitter_ms": _spread_ms(processing_ns(server, client, decoded, paired)),
        "age_at_actuation_ms": percentiles_ms(ages_at_actuation_ns(all_frames, command_verdicts, began_ns, ended_ns)),
        "tau_v_ms": _with_bound(percentiles_ms(tau_v_ns), bound_ms),
        "tau_c_ms": _with_bound(percentiles_ms(tau_c_ns), bound_ms),
        **_page_latencies(client, frames, clocks),
        "stages_ms": stage_percentiles(server, client, frames, tau_c_ns, clocks.offset),
        "frames_sent": len(frames),
        "frames_decoded": len(decoded),
        "frames_unreadable": int(np.sum(~decoded.flags("readable"))),
    }
    return entry, closure_p95_ms


def _page_latencies(client: Record, frames: Table, clocks: RunClocks) -> dict[str, Any]:
    """Return the latencies from a frame's stamp to the page of the person who drives; `n` is 0 if no person drives."""
    pictures = page_pictures_of(client.table("page_picture"), frames)
    bound_ms = clocks.bound_ms
    if bound_ms is not None and len(pictures):
        bound_ms += float(pictures.ints("bound_ns").max()) / NS_PER_MS
    entry = {}
    for name in ("decoded", "shown"):
        times_ns = np.zeros(0, np.int64)
        if clocks.offset is not None:
            times_ns = page_latency_ns(pictures, f"{name}_wall_ns", clocks.offset)
        max_ms = float(times_ns.max()) / NS_PER_MS if len(times_ns) else None
        entry[f"page_{name}_ms"] = {**_with_bound(percentiles_ms(times_ns), bound_ms), "max": max_ms}
    return entry


def _spread_ms(durations_ns: IntArray) -> float | None:
    """Return the 95th percentile minus the median in ms; None without durations."""
    percentiles = percentiles_ms(durations_ns)
    return percentiles["p95"] - percentiles["p50"] if percentiles["n"] else None


def _with_bound(summary: dict[str, Any], bound_ms: float | None) -> dict[str, Any]:
    return {
        "p5": summary["p5"],
        "p50": summary["p50"],
        "p95": summary["p95"],
        "bound": bound_ms if summary["n"] else None,
        "n": summary["n"],
    }


def last_count(record: Record, name: str) -> int | None:
    """Return the last value of a counter on the channel `counts`; None if it was never recorded."""
    values = record.table("counts").ints(name)
    known = values[values != MISSING]
    return int(known[-1]) if len(known) else None
