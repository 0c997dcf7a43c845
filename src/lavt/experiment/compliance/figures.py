"""The figures of the compliance report. No function reads a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lavt.domain import NS_PER_MS, NS_PER_S, FloatArray
from lavt.experiment.compliance.drive_compliance import DriveCompliance
from lavt.experiment.compliance.fleet import condition_name
from lavt.experiment.compliance.ramps import Ramps, joined
from lavt.experiment.report.figures.figure_style import Colours, condition_handles, legend_below, new_figure, tidy

LIMIT_STYLE: dict[str, Any] = {"color": "0.3", "linewidth": 1, "linestyle": ":"}
GRID_POINTS = 160
SHADES: Mapping[str, Any] = {
    "outage": {"color": "#e69f00", "alpha": 0.35},
    "stop": {"color": "#d55e00", "alpha": 0.35},
}


def exceedance_figure(drives: Sequence[DriveCompliance], colours: Colours, limit_ms: float) -> Figure:
    """Return the figure of the share of the commanded time above a limit, over the limit, by condition.

    Solid: frame age; dashed: two-way latency. Both are lower bounds, which are exact if the capture times are known.
    """
    by_condition: dict[str, list[DriveCompliance]] = {}
    for drive in drives:
        by_condition.setdefault(condition_name(drive.entry), []).append(drive)
    figure = new_figure(2.9)
    axes = figure.subplots()
    pooled = {
        name: (joined([drive.age_ns[0] for drive in members]), joined([drive.two_way_ns[0] for drive in members]))
        for name, members in by_condition.items()
    }
    largest_ms = max(2 * limit_ms, *(_finite_p99(age) / NS_PER_MS for age, _ in pooled.values())) * 1.1
    grid_ms = np.linspace(0, largest_ms, GRID_POINTS)
    for name in sorted(pooled):
        for ramps, style in zip(pooled[name], ("-", "--"), strict=True):
            shares = [100 * ramps.time_above(at_ms * NS_PER_MS) / ramps.duration for at_ms in grid_ms]
            axes.plot(grid_ms, shares, color=colours[name], linestyle=style, linewidth=1.2)
    axes.axvline(limit_ms, **LIMIT_STYLE)
    axes.set_ylim(0, 103)
    axes.set_xlim(0, largest_ms)
    tidy(axes, "latency (ms)", "time above it (%)")
    kinds = [
        Line2D([], [], color="0.4", linestyle="-", label="frame age"),
        Line2D([], [], color="0.4", linestyle="--", label="two-way latency"),
        Line2D([], [], label=f"limit {limit_ms:g} ms", **LIMIT_STYLE),
    ]
    legend_below(figure, [*kinds, *condition_handles(sorted(pooled), colours)])
    return figure


def _finite_p99(ramps: Ramps) -> float:
    value = ramps.percentile(0.99)
    return value if value is not None and np.isfinite(value) else 0.0


def drive_figure(drive: DriveCompliance, limit_ms: float) -> Figure:
    """Return the figure of one drive over time: frame age and two-way latency, and speed with the allowed speed.

    The latencies are lower bounds, as in `exceedance_figure`.
    """
    figure = new_figure(3.4)
    ages, speeds = figure.subplots(2, 1, sharex=True)
    low, _ = drive.age_ns
    two_way, _ = drive.two_way_ns
    for ramps, style in ((low, {"color": "#0072b2"}), (two_way, {"color": "#009e73", "linestyle": "--"})):
        time_s, value_ms = _curve(ramps)
        ages.plot(time_s, value_ms / NS_PER_MS, linewidth=0.8, **style)
    ages.axhline(limit_ms, **LIMIT_STYLE)
    ages.set_ylim(bottom=0)
    tidy(ages, "", "ms", f"{drive.entry['run']}")
    ages.set_xlim(0, max(drive.duration_ns, 1) / NS_PER_S)
    shown = (drive.speeds.time_ns >= 0) & (drive.speeds.time_ns <= drive.duration_ns)
    speeds.plot(
        drive.speeds.time_ns[shown] / NS_PER_S, drive.speeds.speed_mps[shown] * 3.6, color="#0072b2", linewidth=1
    )
    time_s, age_ns = _curve(low)
    nominal = drive.entry["nominal_kmh"]
    with np.errstate(divide="ignore", invalid="ignore"):
        allowed = nominal * np.minimum(1.0, limit_ms * NS_PER_MS / age_ns)
    speeds.plot(time_s, allowed, color="#d55e00", linewidth=0.8)
    speeds.set_ylim(0, nominal * 1.12)
    tidy(speeds, "time (s)", "km/h")
    for axes in (ages, speeds):
        _shade(axes, drive)
    handles = [
        Line2D([], [], color="#0072b2", label="frame age, speed"),
        Line2D([], [], color="#009e73", linestyle="--", label="two-way latency"),
        Line2D([], [], label=f"limit {limit_ms:g} ms", **LIMIT_STYLE),
        Line2D([], [], color="#d55e00", label="allowed speed"),
    ]
    has = {"outage": bool(drive.outages), "stop": bool(drive.manoeuvres)}
    handles += [Line2D([], [], linewidth=5, label=name, **style) for name, style in SHADES.items() if has[name]]
    legend_below(figure, handles)
    return figure


def _shade(axes: Axes, drive: DriveCompliance) -> None:
    for begin_ns, end_ns in drive.outages:
        axes.axvspan(begin_ns / NS_PER_S, end_ns / NS_PER_S, linewidth=0, **SHADES["outage"])
    for stop in drive.manoeuvres:
        axes.axvspan(stop.begin_ns / NS_PER_S, stop.end_ns / NS_PER_S, linewidth=0, **SHADES["stop"])


def _curve(ramps: Ramps) -> tuple[FloatArray, FloatArray]:
    """Return times in s and values of the corners of a quantity, with a gap (NaN) where it is unknown or infinite."""
    times = np.column_stack([ramps.begin, ramps.end]).ravel() / NS_PER_S
    values = np.column_stack([ramps.first, ramps.last]).ravel()
    return times, np.where(np.isfinite(values), values, np.nan)
