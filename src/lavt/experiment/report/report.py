"""The report of runs: `summary.json`, and `report/` with the page `index.html`, its figures and its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

from lavt.errors import WorkError
from lavt.experiment.analysis.drive_data import DriveData
from lavt.experiment.analysis.results import read_json, write_json
from lavt.experiment.report import html_page
from lavt.experiment.report.boundary_section import boundary_parts
from lavt.experiment.report.condition_sections import (
    conditions_parts,
    contrast_parts,
    error_table_parts,
    latency_table_parts,
)
from lavt.experiment.report.controller_section import controller_parts
from lavt.experiment.report.figures.figure_style import SETTINGS, condition_colours
from lavt.experiment.report.first_screen import VALIDITY, first_parts
from lavt.experiment.report.replay_section import replay_parts
from lavt.experiment.report.run_sections import (
    DriveSets,
    capture_to_stamp_medians,
    drawn_runs,
    machine_parts,
    read_drives,
    setting_text,
    single_run_parts,
    trajectory_parts,
)
from lavt.experiment.report.sections import (
    ReportContext,
    axis_parts,
    clock_parts,
    degradation_parts,
    group_parts,
    injected_parts,
    lane_change_parts,
    route_parts,
    run_parts,
    stage_parts,
    survival_parts,
    validity_parts,
)
from lavt.experiment.report.speed_limit_section import speed_limit_parts
from lavt.experiment.report.study_section import study_parts
from lavt.experiment.statistics.participants import SCHEMA, compare_studies
from lavt.experiment.statistics.summary import summarize

STUDY = "study.json"
"""The file with the comparisons over the participants of studies."""
TITLE = "LAVT: driving performance over network latency"


def write_report(
    sweep_dir: Path,
    *,
    run_dirs: Sequence[Path] | None = None,
    base: Mapping[str, Any] | None = None,
    speed: Mapping[str, Any] | None = None,
    drives: Mapping[Path, DriveData] | None = None,
    sweeps: Mapping[Path, str] | None = None,
    boundaries: Sequence[Mapping[str, Any]] = (),
    failed: Sequence[Mapping[str, str]] = (),
    answers: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """Write `summary.json` and `report/` into `sweep_dir`, and return the page's path.

    `run_dirs` are the directories of the runs, by default those under `sweep_dir/runs`. `base` is passed to
    `summary.summarize`. `speed` defaults to the value in the existing summary. `drives` has the data of drives that
    were already read, by run directory. If the runs are from several sweeps, `sweeps` has the name of the sweep of each
    run directory. `boundaries` are the contents of `boundary.json` files. `failed` are the failed runs, as in `FAILED`.
    `answers` are those of the participants of a study. If the runs have participants, `study.json` is written, too.
    The page lists as left out: the failed runs, and the runs without a readable result. Raises `WorkError` if no run
    has a result.
    """
    if run_dirs is None:
        run_dirs = sorted(path for path in (sweep_dir / "runs").glob("*") if path.is_dir())
    results, unfinished = _read_results(run_dirs, sweeps or {})
    failed_names = {run["run"] for run in failed}
    left_out = [*failed, *({"run": name, "reason": "no result"} for name in unfinished if name not in failed_names)]
    if not results:
        raise WorkError(f"there is no finished run in {sweep_dir}: a finished run has a result.json in its directory")
    summary_path = sweep_dir / "summary.json"
    if speed is None and summary_path.is_file():
        speed = read_json(summary_path).get("speed")
    summary = summarize([result for _, result in results], speed, base=base, failed=left_out)
    write_json(summary_path, summary)
    studies = compare_studies(summary["runs"], answers)
    if any(run.get("participant") is not None for run in summary["runs"]):
        write_json(sweep_dir / STUDY, {"schema": SCHEMA, "studies": studies})
    report_dir = sweep_dir / "report"
    report_dir.mkdir(parents=True, exist_ok=True)
    report = ReportContext(summary, report_dir, condition_colours(str(run["condition"]) for run in summary["runs"]))
    sets = read_drives(drawn_runs(report, results), drives or {})
    with mpl.rc_context(SETTINGS):
        first = first_parts(report, replay_parts(report, sets), setting_text(report, sets))
        chapters = _chapters(report, sets, boundaries, studies)
    index = report_dir / "index.html"
    index.write_text(html_page.page(TITLE, first, chapters), encoding="utf-8")
    return index


def _chapters(
    report: ReportContext,
    sets: DriveSets,
    boundaries: Sequence[Mapping[str, Any]],
    studies: Sequence[Mapping[str, Any]],
) -> list[html_page.Chapter]:
    """Return the page's chapters in their order; those of results and trajectories are open."""
    results = [
        ("Comparison over the participants", study_parts(studies, report.directory)),
        ("Conditions", conditions_parts(report)),
        ("Driving performance over latency", degradation_parts(report)),
        ("Distance driven and endings", survival_parts(report)),
        ("Maximum tolerable latency", boundary_parts(boundaries, report.directory)),
        ("Comparison of the controllers", controller_parts(report)),
        ("Comparison of presets and settings", group_parts(report)),
        ("Axes of the sweep", axis_parts(report)),
        ("Results by route", route_parts(report)),
    ]
    trajectories = [
        ("Trajectories", trajectory_parts(report, sets)),
        ("Single runs", single_run_parts(report, sets)),
    ]
    latency = [
        ("Latencies of the conditions", latency_table_parts(report)),
        ("Injected and measured latency", injected_parts(report)),
        ("Latency of each stage", stage_parts(report, capture_to_stamp_medians(sets))),
    ]
    statistics = [
        ("Planned contrasts", contrast_parts(report)),
        ("Errors of lane keeping", error_table_parts(report)),
    ]
    validity = [
        ("Valid and invalid runs", validity_parts(report)),
        ("Clock offset between two machines", clock_parts(report)),
        ("Versions and machines", machine_parts(report, sets)),
    ]
    every_run = [
        ("All runs", run_parts(report)),
        ("Lane changes", lane_change_parts(report)),
        ("Speed limits", speed_limit_parts(report)),
    ]
    return [
        html_page.Chapter("Results", results, is_open=True),
        html_page.Chapter("Trajectories", trajectories, is_open=True),
        html_page.Chapter("Latency", latency),
        html_page.Chapter("Statistics", statistics),
        html_page.Chapter(VALIDITY, validity),
        html_page.Chapter("Every run", every_run),
    ]


def _read_results(
    run_dirs: Sequence[Path], sweeps: Mapping[Path, str]
) -> tuple[list[tuple[Path, dict[str, Any]]], list[str]]:
    """Return the directories of the finished runs with their results, and the names of the other runs."""
    results: list[tuple[Path, dict[str, Any]]] = []
    unfinished: list[str] = []
    for directory in run_dirs:
        sweep = {"sweep": sweeps[directory]} if directory in sweeps else {}
        try:
            results.append((directory, {**read_json(directory / "result.json"), **sweep}))
        except WorkError:
            unfinished.append(directory.name)
    return results, unfinished
