"""The tables of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lavt.experiment.breakdown import Share
from lavt.experiment.page import NOTHING, interval, latency, number, percent, table, with_bound

FIDELITY_SAYS = {
    "video": "network and clocks are modelled, pictures, codec and packets are real",
    "pixels": "network, clocks and codec are modelled, pictures are real",
    "geometry": "network, clocks, codec, camera and perception are modelled, the lane is seen without fault",
}


def how_it_was_driven(runs: Sequence[Mapping[str, Any]]) -> str:
    """Say in words whether time was real, what was modelled, and who injected the delay."""
    ways = {(run["time"], run.get("fidelity") or "video", run["injection"]) for run in runs}
    return "; ".join(
        f"virtual time, fidelity {fidelity}: {FIDELITY_SAYS[fidelity]}"
        if time == "virtual"
        else f"real time, {'nothing injected' if injection == 'none' else f'injected by {injection}'}"
        for time, fidelity, injection in sorted(ways, key=str)
    )


def condition_table(conditions: Mapping[str, Mapping[str, Any]]) -> str:
    """One row a condition, as in the paper, with what was injected beside what was measured."""
    headers = [
        "condition",
        "injected ms (video / control)",
        "runs",
        "completed",
        "95 % interval",
        "collisions / run",
        "lane invasions / run",
        "p95 error m",
        "95 % interval",
        "loop ms",
        "τ video ms",
        "τ control ms",
    ]
    rows = [
        [
            name,
            f"{number(entry['injected_ms']['video'], 0)} / {number(entry['injected_ms']['control'], 0)}",
            str(entry["runs"]),
            percent(entry["completion_rate"]),
            interval(entry["completion_interval"], unit=100.0),
            number(entry["collisions_per_run"], 2),
            number(entry["lane_invasions_per_run"], 2),
            number(entry["p95_m"], 2),
            interval(entry["p95_interval"], digits=2),
            latency(entry["loop_ms"]),
            latency(entry["tau_v_ms"]),
            latency(entry["tau_c_ms"]),
        ]
        for name, entry in conditions.items()
    ]
    return table(headers, rows)


def run_table(runs: Sequence[Mapping[str, Any]]) -> str:
    """One row a run: what it was, how it ended, and whether it may count."""
    headers = ["run", "time", "route", "condition", "ending", "distance m", "loop ms", "p95 error m", "validity"]
    rows = [
        [
            str(run["run"]),
            f"{run['time']}, {run.get('fidelity') or 'video'}, {run['injection']}",
            str(run["route"]),
            str(run["condition"]),
            str(run["ending"] or NOTHING),
            number(run["distance_m"], 0),
            number(run["loop_ms"]["p50"]),
            number(run["p95_m"], 2),
            "valid" if run["valid"] else "not valid: " + "; ".join(run["invalid_because"]),
        ]
        for run in runs
    ]
    return table(headers, rows, text_columns=[8])


def clock_table(runs: Sequence[Mapping[str, Any]]) -> str:
    """One row for each run whose two sides had clocks of their own: Delta, who says it, and what the probe says."""
    headers = ["run", "Delta by", "Delta ms", "drift ppm", "by the probe ms"]
    rows = [
        [
            str(run["run"]),
            str(run["delta"]["source"]),
            with_bound(run["delta"]["ms"], run["delta"]["bound_ms"], digits=3),
            number(run["delta"]["drift_ppm"], 2),
            with_bound(run["delta"]["probe_ms"], run["delta"]["probe_bound_ms"], digits=3),
        ]
        for run in runs
    ]
    return table(headers, rows, text_columns=[1])


def hop_table(shares: Mapping[str, Sequence[Share]], captured_ms: Mapping[str, float | None]) -> str:
    """One row a hop in the order of a frame's life, one column a condition: medians in ms.

    `captured_ms` is how long a frame's stamp came after its exposure: the first row, though the loop begins after it.
    """
    hops = list(dict.fromkeys((node, hop) for every in shares.values() for node, hop, _ in every))
    durations = {name: {(node, hop): ms for node, hop, ms in every} for name, every in shares.items()}
    before = ["unknown" if captured_ms[name] is None else number(captured_ms[name], 2) for name in shares]
    rows = [[f"{node}: {hop}", *(number(of.get((node, hop)), 2) for of in durations.values())] for node, hop in hops]
    return table(["hop, median ms", *durations], [["camera: capture to stamp, before the loop", *before], *rows])


def machine_table(annotations: Mapping[str, Mapping[str, str]]) -> str:
    """Show what a run's record says of versions and machine."""
    rows = [[name, key, value] for name in sorted(annotations) for key, value in annotations[name].items()]
    return table(["", "", ""], rows or [["not recorded", "", ""]], text_columns=[1, 2])
