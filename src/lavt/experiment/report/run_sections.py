"""The sections of a report that need single runs: trajectories, received frames, versions and machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lavt.clock import calendar_time
from lavt.domain import NS_PER_S, Picture
from lavt.experiment.analysis.drive_data import DriveData, capture_to_stamp_ms, one_of_each_condition, read_drive
from lavt.experiment.report import html_page
from lavt.experiment.report.figures.run_figures import (
    cross_track_figure,
    frames_figure,
    time_figure,
    trajectories_figure,
)
from lavt.experiment.report.files import save_figure, save_table
from lavt.experiment.report.groups import differing_settings, is_in_group, title_of
from lavt.experiment.report.sections import Parts, ReportContext
from lavt.experiment.report.table_format import html_of
from lavt.experiment.report.tables import machine_table
from lavt.experiment.statistics.by_road import is_key_part
from lavt.recording.record import read_record

SHOWN_FRAMES = 4

DRAWN_GROUPS = 4
"""If there are more groups than this, the figures show only the group of the sweep's base config or, if there is no
such group, the first group."""

MAX_PANELS = 3
"""The maximum number of routes, or of runs, in one figure: the paper has three key parts and three whole routes."""

DriveSets = Mapping[tuple[str, str], Sequence[DriveData]]
"""Drives by kind of time (`virtual` or `real`) and by title of their group (see `groups.py`; "" in real time). Each set
of drives is drawn in separate figures."""

Runs = Sequence[tuple[Path, Mapping[str, object]]]
"""For each run, its directory and its entry in the summary's `runs`."""


def drawn_runs(report: ReportContext, runs: Runs) -> dict[tuple[str, str], list[tuple[Path, Mapping[str, object]]]]:
    """Return the runs whose drives are drawn, by kind of time and title of their group."""
    groups, names = report.groups, differing_settings(report.groups)
    if len(groups) > DRAWN_GROUPS:
        groups = report.base or groups[:1]
    recorded = [(directory, run) for directory, run in runs if (directory / "server.mcap").is_file()]
    virtual = [(directory, run) for directory, run in recorded if run["time"] == "virtual"]
    sets = {
        ("virtual", title_of(group, names)): [(directory, run) for directory, run in virtual if is_in_group(run, group)]
        for group in groups
    }
    sets["real", ""] = [(directory, run) for directory, run in recorded if run["time"] == "real"]
    return {key: members for key, members in sets.items() if members}


def read_drives(
    sets: Mapping[tuple[str, str], Runs], already_read: Mapping[Path, DriveData]
) -> dict[tuple[str, str], list[DriveData]]:
    """Return the drives of `sets`, and read the ones that are not in `already_read`."""
    return {
        key: [already_read.get(directory) or read_drive(directory, run) for directory, run in members]
        for key, members in sets.items()
    }


def setting_text(report: ReportContext, sets: DriveSets) -> str:
    """Return sentences on the speed, the lane width and the date of the runs, as far as the records have them.

    The clock of runs in virtual time is simulated, so they have no date. If not all runs are drawn, the speed is left
    out, because the record of a run that is not drawn is not read.
    """
    runs, drives = report.summary["runs"], [drive for members in sets.values() for drive in members]
    speeds_mps = [float(np.median(drive.truth.floats("speed_mps"))) for drive in drives if len(drive.truth)]
    speeds = [round(speed_mps * 3.6) for speed_mps in speeds_mps if np.isfinite(speed_mps)]
    widths_m = [(run.get("lane_kept") or {}).get("lane_width_m") for run in runs]
    widths = [round(width_m, 1) for width_m in widths_m if width_m is not None]
    dates = [
        calendar_time(drive.began_wall_ns).date().isoformat()
        for drive in drives
        if drive.result["time"] == "real" and drive.began_wall_ns is not None
    ]
    sentences = []
    if len(speeds) == len(runs):
        sentences.append(f"The median speed of a run is {_range(speeds)} km/h.")
    if widths:
        sentences.append(f"The lanes are {_range(widths)} m wide.")
    if dates:
        sentences.append(f"The runs in real time were driven on {_range(dates)} (UTC).")
    return " ".join(sentences)


def _range(values: Sequence[float] | Sequence[str]) -> str:
    """Return the lowest and the highest of values, or the only one."""
    in_order = sorted(values)
    return f"{in_order[0]}" if in_order[0] == in_order[-1] else f"{in_order[0]} to {in_order[-1]}"


def trajectory_parts(report: ReportContext, sets: DriveSets) -> Parts:
    """Return the figures of all trajectories and of their cross-track error.

    The trajectories on key parts and those on whole routes are in separate figures.
    """
    parts = []
    for (kind, title), drives in sets.items():
        routes: dict[str, list[DriveData]] = {}
        for drive in sorted(drives, key=lambda drive: str(drive.result["route"])):
            if len(drive.truth):
                routes.setdefault(str(drive.result["route"]), []).append(drive)
        origin = f"{kind} time{f', {title}' if title else ''}"
        suffix = "_".join(word for word in (kind, html_page.slug(title)) if word)
        all_drives = [drive for members in routes.values() for drive in members]
        for name, shown in _figures_of(list(routes)):
            shown_routes = {route: routes[route] for route in shown}
            figure = trajectories_figure(shown_routes, report.colours)
            caption = (
                f"All trajectories, {origin}. Each route is rotated to fit. A red cross marks the end of a run that "
                "ended early."
            )
            alternative = f"trajectories on routes {', '.join(shown)}"
            trajectories = save_figure(report.directory, f"trajectories_{name}_{suffix}", figure, alternative, caption)
            caption = f"Distance from the lane centre along the same routes, {origin}."
            if any(drive.result.get("lane_kept") for drive in all_drives):
                caption += " Between the dashed lines, the car counts as in its own lane."
            figure = cross_track_figure(shown_routes, report.colours, all_drives)
            alternative = f"cross-track error on routes {', '.join(shown)}"
            errors = save_figure(report.directory, f"cross_track_{name}_{suffix}", figure, alternative, caption)
            parts.append(html_page.figures([trajectories, errors]))
    return parts


def _figures_of(routes: Sequence[str]) -> list[tuple[str, Sequence[str]]]:
    """Return the name and the routes of each figure: key parts first, at most `MAX_PANELS` routes in a figure."""
    routes_by_name = {
        "key": [route for route in routes if is_key_part(route)],
        "whole": [route for route in routes if not is_key_part(route)],
    }
    return [
        (f"{name}{begin // MAX_PANELS + 1 if begin else ''}", members[begin : begin + MAX_PANELS])
        for name, members in routes_by_name.items()
        for begin in range(0, len(members), MAX_PANELS)
    ]


def single_run_parts(report: ReportContext, sets: DriveSets) -> Parts:
    """Return for each kind of time a figure with one run of each condition, and a figure of received frames."""
    parts = []
    for kind, drives in _first_sets(sets).items():
        chosen = one_of_each_condition(drives)
        driven = [drive for drive in chosen if len(drive.truth)]
        for begin in range(0, len(driven), MAX_PANELS):
            shown = driven[begin : begin + MAX_PANELS]
            names = ", ".join(str(drive.result["run"]) for drive in shown)
            caption = (
                "Angle of the road wheels and distance from the lane centre over time; left is positive. One run of "
                f"each condition, {kind} time: {names}."
            )
            figure = time_figure(shown, report.colours, driven)
            name = f"time_{kind}{begin // MAX_PANELS + 1 if begin else ''}"
            parts.append(save_figure(report.directory, name, figure, "steering over time", caption))
        pictures = received_pictures(chosen[0].directory / "client.mcap")
        if pictures:
            caption = (
                f"Frames as the client received them in the run {chosen[0].result['run']}, with the time since the "
                "first of them. The stamp is at the top left."
            )
            figure = frames_figure(pictures)
            parts.append(save_figure(report.directory, f"frames_{kind}", figure, "received frames", caption))
    return [html_page.figures(parts)] if parts else []


def _first_sets(sets: DriveSets) -> dict[str, Sequence[DriveData]]:
    """Return the first set of each kind of time."""
    first: dict[str, Sequence[DriveData]] = {}
    for (kind, _), drives in sets.items():
        first.setdefault(kind, drives)
    return first


def capture_to_stamp_medians(sets: DriveSets) -> dict[str, dict[str, float | None]]:
    """Return the median time in ms from capture to stamp of one run, by kind of time and condition."""
    return {
        kind: {
            drive.condition: capture_to_stamp_ms(drive.directory / "server.mcap")
            for drive in one_of_each_condition(drives)
        }
        for kind, drives in _first_sets(sets).items()
    }


def received_pictures(client_record: Path) -> list[tuple[str, Picture]]:
    """Return `SHOWN_FRAMES` evenly spaced pictures from the received video, each with its time since the first of them.

    Without video, the result is empty.
    """
    units = read_record(client_record, channels=()).video() if client_record.is_file() else []
    if not units:
        return []
    from lavt.transport.video.h264 import Decoder  # noqa: PLC0415 (a report without video needs no codec)

    shown = {len(units) * (2 * index + 1) // (2 * SHOWN_FRAMES) for index in range(SHOWN_FRAMES)}
    decoder = Decoder()
    pictures: list[tuple[int, Picture]] = []
    for index, (stamp_ns, unit) in enumerate(units):
        decoded = decoder.decode(unit)
        if index in shown and decoded is not None:
            pictures.append((stamp_ns, decoded.picture))
    return [(f"{(stamp_ns - pictures[0][0]) / NS_PER_S:.1f} s", picture) for stamp_ns, picture in pictures]


def machine_parts(report: ReportContext, sets: DriveSets) -> Parts:
    """Return versions and machines as the drawn runs recorded them.

    Runs with equal values share a table.
    """
    drives = [drive for members in sets.values() for drive in members]
    first_and_count: dict[str, tuple[DriveData, int]] = {}  # by the HTML of the table
    for drive in drives:
        html = html_of(machine_table(drive.annotations))
        first, count = first_and_count.get(html, (drive, 0))
        first_and_count[html] = (first, count + 1)
    parts = []
    for number, (first, count) in enumerate(first_and_count.values(), start=1):
        text = f"Recorded by {count} of {len(report.summary['runs'])} runs; the first is {first.result['run']}:"
        table = machine_table(first.annotations)
        parts += [html_page.paragraph(text, is_note=True), save_table(report.directory, f"machine_{number}", table)]
    return parts
