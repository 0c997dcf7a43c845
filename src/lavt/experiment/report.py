"""The report of a sweep: `summary.json`, and `report/index.html` with its figures as PNG beside it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from lavt.domain import Picture
from lavt.errors import WorkError
from lavt.experiment import page
from lavt.experiment.breakdown import Share, breakdown, capture_to_stamp_ms
from lavt.experiment.clocks import PROBE, SAME_KERNEL
from lavt.experiment.drives import Drive, one_of_each_condition, read_drive
from lavt.experiment.figures import (
    Colours,
    breakdown_figure,
    condition_colours,
    frames_figure,
    injected_figure,
    loop_figure,
    route_figure,
    time_figure,
)
from lavt.experiment.record import read_record
from lavt.experiment.report_tables import (
    clock_table,
    condition_table,
    hop_table,
    how_it_was_driven,
    machine_table,
    run_table,
)
from lavt.experiment.results import read_json, write_json
from lavt.experiment.summary import summarize

SHOWN_FRAMES = 4
ONE_CLOCK = (None, SAME_KERNEL)
"""Sources of Delta that have no figure: unknown, as the run's own row says, or the same clock."""


def write_report(
    sweep_dir: Path,
    *,
    run_dirs: Sequence[Path] | None = None,
    base: Mapping[str, Any] | None = None,
    speed: Mapping[str, Any] | None = None,
) -> Path:
    """Write `summary.json` and `report/` into `sweep_dir`, and return the page's path.

    `run_dirs` are the runs to report, by default those under `sweep_dir/runs`. `base` is that of
    `summary.summarize`; `speed`, where it is not given, is kept from the summary that is already there. A run whose
    result cannot be read is left out, and the page says so. Raises `WorkError` where no run is left.
    """
    if run_dirs is None:
        run_dirs = sorted(path for path in (sweep_dir / "runs").glob("*") if path.is_dir())
    results, left_out = _read_results(run_dirs)
    if not results:
        raise WorkError(f"there is no finished run in {sweep_dir}: a run leaves a result.json in its directory")
    summary_path = sweep_dir / "summary.json"
    if speed is None and summary_path.is_file():
        speed = read_json(summary_path).get("speed")
    summary = summarize([result for _, result in results], speed, base=base)
    write_json(summary_path, summary)
    report_dir = sweep_dir / "report"
    report_dir.mkdir(parents=True, exist_ok=True)
    drives = _read_drives(results)
    colours = condition_colours(str(run["condition"]) for run in summary["runs"])
    parts = [
        *_head(summary, left_out),
        *_overview(summary, report_dir, colours),
        *(part for kind in ("virtual", "real") for part in _of_one_kind(kind, drives, report_dir, colours)),
        *_groups(summary),
        page.heading("Every run"),
        run_table(summary["runs"]),
        *_clocks(summary["runs"]),
        *_machines(drives),
    ]
    index = report_dir / "index.html"
    index.write_text(page.page("LAVT: latency and driving", parts), encoding="utf-8")
    return index


def _read_results(run_dirs: Sequence[Path]) -> tuple[list[tuple[Path, dict[str, Any]]], list[str]]:
    results: list[tuple[Path, dict[str, Any]]] = []
    left_out: list[str] = []
    for directory in run_dirs:
        try:
            results.append((directory, read_json(directory / "result.json")))
        except WorkError:
            left_out.append(directory.name)
    return results, left_out


def _read_drives(results: Sequence[tuple[Path, Mapping[str, Any]]]) -> list[Drive]:
    return [read_drive(directory, result) for directory, result in results if (directory / "server.mcap").is_file()]


def _save(figure: Figure, report_dir: Path, name: str, alternative: str, caption: str) -> str:
    figure.savefig(report_dir / name)
    return page.picture(name, alternative, caption)


def _head(summary: Mapping[str, Any], left_out: Sequence[str]) -> list[str]:
    runs = summary["runs"]
    counted = ", ".join(
        f"{sum(run['time'] == kind for run in runs)} in {kind} time"
        for kind in ("virtual", "real")
        if any(run["time"] == kind for run in runs)
    )
    invalid = sum(not run["valid"] for run in runs)
    verdict = f"{invalid} not valid, for reasons given below, and in no statistic"
    parts = [page.paragraph(f"{len(runs)} runs: {counted}. {verdict if invalid else 'All of them count'}.")]
    speed = summary["speed"]
    if speed["wall_s"]:
        factor = speed["simulated_s"] / speed["wall_s"]
        parts.append(
            page.paragraph(
                f"{speed['simulated_s']:.0f} s were simulated in {speed['wall_s']:.0f} s with {speed['jobs']} jobs: "
                f"{factor:.1f} times as fast as real time.",
                note=True,
            )
        )
    if left_out:
        parts.append(page.paragraph("Left out, because they did not finish: " + ", ".join(left_out) + ".", note=True))
    return parts


def _overview(summary: Mapping[str, Any], report_dir: Path, colours: Colours) -> list[str]:
    kinds = {"virtual": summary["conditions"], "real": summary["real"]}
    kinds = {kind: conditions for kind, conditions in kinds.items() if conditions}
    parts = [page.heading("Conditions")]
    for kind, conditions in kinds.items():
        runs = [run for run in summary["runs"] if run["time"] == kind]
        parts += [page.heading(how_it_was_driven(runs), 3), condition_table(conditions)]
    parts += [
        page.paragraph(
            "Latencies in ms: median (p5 to p95) ± how wrong the offset between the clocks can make them. The loop "
            "latency needs no offset. Cross-track error is over completed runs only: read it beside the completion.",
            note=True,
        ),
        _save(
            loop_figure(kinds, colours),
            report_dir,
            "loop.png",
            "completion and error over loop latency",
            "What the loop latency, frame stamped to its command applied on the server's own clock, does to driving.",
        ),
        _save(
            injected_figure(kinds, colours),
            report_dir,
            "injected.png",
            "injected against measured latency",
            "Injected against measured one-way latency: median, p5 to p95. The grey line is the latency of the least "
            "delayed condition, plus the injected delay; below, how far each median is from it, with the bound.",
        ),
    ]
    return parts


def _of_one_kind(kind: str, all_drives: Sequence[Drive], report_dir: Path, colours: Colours) -> list[str]:
    """Figures of single runs; those in real and in virtual time are never drawn into one."""
    drives = [drive for drive in all_drives if drive.result["time"] == kind]
    if not drives:
        return []
    chosen = one_of_each_condition(drives)
    driven = [drive for drive in chosen if len(drive.truth)]
    parts = [page.heading(f"Runs in {kind} time")]
    parts += _breakdown_parts(kind, chosen, report_dir)
    if driven:
        caption = "Road wheel angle and distance from the lane's centre, left positive; one run of each condition: "
        names = ", ".join(str(drive.result["run"]) for drive in driven)
        parts.append(
            _save(
                time_figure(driven, colours), report_dir, f"time_{kind}.png", "steering over time", f"{caption}{names}."
            )
        )
    for route in sorted({str(drive.result["route"]) for drive in drives}):
        on_route = [drive for drive in drives if str(drive.result["route"]) == route and len(drive.truth)]
        if on_route:
            name = f"route_{re.sub('[^A-Za-z0-9]+', '_', route).strip('_')}_{kind}.png"
            caption = f"Route {route}: {len(on_route)} runs. A red cross is where a run ended before its goal."
            parts.append(
                _save(route_figure(on_route, colours), report_dir, name, f"trajectories on route {route}", caption)
            )
    pictures = received_pictures(chosen[0].directory / "client.mcap")
    if pictures:
        caption = f"Pictures as the client received them, run {chosen[0].result['run']}; the stamp is at the top left."
        parts.append(_save(frames_figure(pictures), report_dir, f"frames_{kind}.png", "received pictures", caption))
    return parts


def _breakdown_parts(kind: str, chosen: Sequence[Drive], report_dir: Path) -> list[str]:
    shares: dict[str, list[Share]] = {}
    captured_ms: dict[str, float | None] = {}
    for drive in chosen:
        if (drive.directory / "client.mcap").is_file():
            server, client = (read_record(drive.directory / f"{side}.mcap") for side in ("server", "client"))
            shares[drive.condition] = breakdown(server, client, drive.result)
            captured_ms[drive.condition] = capture_to_stamp_ms(server)
    shares = {name: every for name, every in shares.items() if every}
    if not shares:
        return []
    caption = "Where the median loop goes, one run of each condition, in the order of a frame's life."
    figure = _save(breakdown_figure(shares), report_dir, f"hops_{kind}.png", "latency of each hop", caption)
    return [figure, hop_table(shares, captured_ms)]


def received_pictures(client_record: Path) -> list[tuple[str, Picture]]:
    """Decode the video as the client received it, and choose `SHOWN_FRAMES` pictures, evenly spread; [] without one."""
    units = read_record(client_record, channels=()).video() if client_record.is_file() else []
    if not units:
        return []
    from lavt.transport.h264 import Decoder  # noqa: PLC0415 (a report without pictures needs no codec)

    shown = {len(units) * (2 * index + 1) // (2 * SHOWN_FRAMES) for index in range(SHOWN_FRAMES)}
    decoder = Decoder()
    pictures: list[tuple[str, Picture]] = []
    for index, (stamp_ns, unit) in enumerate(units):
        decoded = decoder.decode(unit)
        if index in shown and decoded is not None:
            pictures.append((f"{(stamp_ns - units[0][0]) / 1e9:.1f} s", decoded.picture))
    return pictures


def _groups(summary: Mapping[str, Any]) -> list[str]:
    groups = summary["groups"]
    if len(groups) < 2:
        return []
    parts = [page.heading("Groups (virtual time)")]
    for group in groups:
        name = ", ".join(f"{key} {value}" for key, value in group.items() if key != "conditions" and value is not None)
        parts += [page.heading(name, 3), condition_table(group["conditions"])]
    return parts


def _clocks(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say how far the clocks of two machines were apart; in virtual time they are modelled."""
    apart = [run for run in runs if run["time"] == "real" and (run.get("delta") or {}).get("source") not in ONE_CLOCK]
    if not apart:
        return []
    parts = [
        page.heading("Clocks of two machines"),
        clock_table(apart),
        page.paragraph(
            "Delta is the server's clock less the client's in the middle of the drive; ± is the largest bound during "
            "it, that of every one-way latency of the run. The hosts' sources of time and the probe are two opinions: "
            "a run in which they contradict each other does not count.",
            note=True,
        ),
    ]
    if any(run["delta"]["source"] == PROBE for run in apart):
        parts.append(
            page.paragraph(
                "By the probe: no other source of time said how the clocks were. Its bound is half the round trip "
                "and the drift since; if one way is slower than the other, that is hidden inside it.",
                note=True,
            )
        )
    return parts


def _machines(drives: Sequence[Drive]) -> list[str]:
    """Versions and machine as the runs recorded them; runs that agree share a table."""
    by_text: dict[str, tuple[str, int]] = {}
    for drive in drives:
        html = machine_table(drive.annotations)
        first, many = by_text.get(html, (str(drive.result["run"]), 0))
        by_text[html] = (first, many + 1)
    parts = [page.heading("Versions and machine")]
    for html, (first, many) in by_text.items():
        parts += [page.paragraph(f"{many} runs, the first of them {first}:", note=True), html]
    return parts
