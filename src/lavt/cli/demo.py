"""`lavt demo`: show what delay does to driving by video, and report it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from lavt.cli import console
from lavt.cli.live_view import LiveView
from lavt.cli.progress import progress
from lavt.config import RunConfig, SweepConfig
from lavt.config_file import load_config, parse_config, shipped
from lavt.experiment.analysis.results import read_json
from lavt.experiment.runs.plan import plan_run, plan_sweep
from lavt.experiment.runs.run import run_once
from lavt.operating_system import missing_in_real_time
from lavt.recording.output_directory import disk_errors_named, prepare_directory

if TYPE_CHECKING:
    from lavt.experiment.sweep.sweep import SweepResult

REAL_CONDITIONS = ("L0", "L5")
VIRTUAL_CONDITIONS = ("L0", "L1", "L2", "L3", "L4", "L5")

ROADS = tuple(f"random_{number}" for number in range(1, 7))
"""The roads of the virtual part: as many as an interval for roads of their kind takes."""
WHY_THESE_ROADS = (
    "Now the first six random roads, without pictures: repeated runs of one road would be nearly equal, and six is the "
    "smallest number of roads with an interval for others of their kind."
)

HEADINGS = ("condition", "injected, ms\nvideo + control", "loop, ms\nmedian", "in own lane\n95 % interval", "P95\nm")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(demo)


def demo(out: console.OutOption = None, as_json: console.JsonOption = False) -> None:
    """Run the demo: show what delay does to driving by video.

    The demo drives by video in real time, without delay (L0) and with the most delay (L5), and without pictures in
    virtual time on six roads under L0 to L5, all on this machine.

    Example: lavt demo --out out/demo
    """
    out = out or Path("out") / "demo"
    config = shipped("configs/demo.yaml")
    prepare_directory(out)
    with console.interruptible(), disk_errors_named(out):
        if missing := missing_in_real_time():
            console.print_message(f"the part in real time needs Linux (this system has no {missing}), and is left out")
        else:
            _drive_real(config, out)
    with console.interruptible("runs"), disk_errors_named(out):
        sweep_result, speed = _drive_virtual(config, out)
    from lavt.experiment.report.report import write_report  # noqa: PLC0415 (slow: scipy, matplotlib)

    console.print_message("writing the report")
    drives = {drive.directory: drive for drive in sweep_result.drives}
    failed = [{"run": name, "reason": reason} for name, reason in sweep_result.failed]
    with disk_errors_named(out):
        page = write_report(out, speed=speed, drives=drives, failed=failed)
    summary = read_json(out / "summary.json")
    if as_json:
        console.print_json(summary)
    else:
        Console().print(summary_table(summary))
        for sentence in closing_sentences(summary):
            console.print_result(sentence)
        console.print_result(f"the report is {page}: open it in a browser")
    if failed:
        raise typer.Exit(1)


def _drive_real(config: Path, out: Path) -> None:
    for name in REAL_CONDITIONS:
        run_config = load_config(RunConfig, config, ["time=real", f"network.condition={name}"])
        planned_run = plan_run(run_config, name=f"real_{run_config.vehicle.route}_{name}_00")
        with LiveView(f"real time, {name}") as view:
            result = run_once(planned_run, out / "runs" / planned_run.name, progress=view.update)
        console.print_message(f"real time, {name}: {describe_ending(result)}")


def _drive_virtual(config: Path, out: Path) -> tuple[SweepResult, dict[str, Any] | None]:
    """Drive the roads under all conditions; return the runs and the summary's entry `speed`."""
    base = load_config(RunConfig, config, ["time=virtual", "fidelity=geometry"])
    axes = {"routes": list(ROADS), "conditions": list(VIRTUAL_CONDITIONS)}
    planned_runs = plan_sweep(parse_config(SweepConfig, {**base.model_dump(mode="json"), **axes}, str(config)))
    from lavt.experiment.sweep.sweep import run_all  # noqa: PLC0415 (slow: scipy, matplotlib)

    console.print_message(WHY_THESE_ROADS)
    with progress(f"virtual time, L0 to L5 on {len(ROADS)} roads", len(planned_runs)) as report_done:
        return run_all(planned_runs, out / "runs", jobs=None, on_progress=report_done)


def describe_ending(run: Mapping[str, Any]) -> str:
    """Return how a run ended, in words, with the lane of a completed run if it is known, and why it is not valid."""
    ending = str(run["ending"]).replace("_", " ")
    if run["ending"] == "completed" and run.get("completed_in_own_lane") is False:
        ending = "completed, but not in its own lane"
    elif run["ending"] == "completed" and run.get("completed_in_own_lane"):
        ending = "completed in its own lane"
    return ending if run["valid"] else f"{ending} (not valid: {_reasons(run)})"


def _reasons(run: Mapping[str, Any]) -> str:
    return "; ".join(str(reason["text"]) for reason in run["invalid_reasons"])


def summary_table(summary: Mapping[str, Any]) -> Table:
    """Return a table of at most 80 columns: a row for each condition in virtual time and each run in real time."""
    table = Table(*HEADINGS, box=box.SIMPLE_HEAD)
    for name, entry in summary["conditions"].items():
        table.add_row(
            name,
            _injected(entry),
            _median(entry),
            own_lane_text(entry),
            _metres(entry["by_road"]["p95_all_runs_m"]["mean"]),
        )
    table.add_section()
    for run in (run for run in summary["runs"] if run["time"] == "real"):
        kept = {True: "yes", False: "no", None: "unknown"}[run.get("completed_in_own_lane")]
        kept = f"{kept}: {str(run['ending']).replace('_', ' ')}" if run["ending"] != "completed" else kept
        table.add_row(
            f"{run['condition']}, by video",
            _injected(run),
            _median(run),
            kept if run["valid"] else f"{kept}; not valid",
            _metres(run["p95_m"]),
        )
    return table


def _injected(entry: Mapping[str, Any]) -> str:
    return f"{entry['injected_ms']['video']:g} + {entry['injected_ms']['control']:g}"


def _median(entry: Mapping[str, Any]) -> str:
    median_ms = entry["loop_ms"]["p50"]
    return "unknown" if median_ms is None else f"{median_ms:.0f}"


def _metres(value_m: float | None) -> str:
    return "" if value_m is None else f"{value_m:.2f}"


def own_lane_text(entry: Mapping[str, Any]) -> str:
    """Return how many runs of a condition were completed in their own lane, with the interval of the rate."""
    interval = entry["own_lane_completion_interval"]
    if interval is None:
        return "unknown"
    low, high = (round(bound * 100) for bound in interval)
    return f"{entry['completed_in_own_lane']} of {entry['runs']} ({low} to {high} %)"


def closing_sentences(summary: Mapping[str, Any]) -> list[str]:
    """Return three sentences: what the demo has shown, what it has not, and which of its runs are valid."""
    return [_shown(summary), _not_shown(), _validity(summary["runs"])]


def _shown(summary: Mapping[str, Any]) -> str:
    conditions = summary["conditions"]
    text = "Shown: no run in virtual time could be used"
    if conditions:
        least, most = conditions[min(conditions)], conditions[max(conditions)]
        text = (
            f"Shown: without injected delay {own_lane_text(least)} roads were completed in the own lane, and with "
            f"{_injected(most)} ms {own_lane_text(most)}"
        )
    real = [run for run in summary["runs"] if run["time"] == "real" and run["valid"]]
    endings = "; ".join(f"{run['condition']} {describe_ending(run)}" for run in real)
    return f"{text}; by video in real time: {endings}." if endings else f"{text}."


def _not_shown() -> str:
    return (
        "Not shown: where driving fails for another controller, car or kind of road. The gains (paper_calibrated) are "
        "fitted to the paper (Khalil and Kwon, 2026), so the delay at which completion falls is an input; the runs in "
        "virtual time have no pictures; and one run in real time is an example, not a statistic."
    )


def _validity(runs: list[Mapping[str, Any]]) -> str:
    invalid = [run for run in runs if not run["valid"]]
    if not invalid:
        return f"Valid: all {len(runs)} runs."
    named = "; ".join(f"{run['time']} time, {run['condition']}: {_reasons(run)}" for run in invalid[:2])
    busy = (
        ""
        if any(run["time"] == "virtual" for run in invalid)
        else (
            " A busy machine does this to runs in real time; those in virtual time do not depend on it, and a demo on "
            "an idle machine repeats it."
        )
    )
    return f"Valid: {len(runs) - len(invalid)} of {len(runs)} runs; the others are in no statistic ({named}).{busy}"
