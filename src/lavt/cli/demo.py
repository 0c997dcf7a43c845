"""`lavt demo`: drive under a few network conditions and report, as a short example of what LAVT measures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer
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
from lavt.recording.output_directory import prepare_directory

REAL_CONDITIONS = ("L0", "L5")
VIRTUAL_CONDITIONS = ("L0", "L1", "L2", "L3", "L4", "L5")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(demo)


def demo(out: console.OutOption = None, as_json: console.JsonOption = False) -> None:
    """Run the demo: drive by video under L0 to L5 and report.

    The demo drives in real time under L0 and L5, and in virtual time under L0 to L5, all on this machine.

    Example: lavt demo --out out/demo
    """
    out = out or Path("out") / "demo"
    config = shipped("configs/demo.yaml")
    prepare_directory(out)
    with console.interruptible():
        _drive_real(config, out)
        failed, speed = _drive_virtual(config, out)
    from lavt.experiment.report.report import write_report  # noqa: PLC0415 (slow: scipy, matplotlib)

    page = write_report(out, speed=speed)
    summary = read_json(out / "summary.json")
    if as_json:
        console.print_json(summary)
    else:
        _print_table(summary)
        console.print_result(f"the report is {page}")
    if failed:
        raise typer.Exit(1)


def _drive_real(config: Path, out: Path) -> None:
    for name in REAL_CONDITIONS:
        run_config = load_config(RunConfig, config, ["time=real", f"network.condition={name}"])
        planned_run = plan_run(run_config, name=f"real_{run_config.vehicle.route}_{name}_00")
        with LiveView(f"real time, {name}") as view:
            result = run_once(planned_run, out / "runs" / planned_run.name, progress=view.update)
        console.print_message(f"real time, {name}: {result['ending']}")


def _drive_virtual(config: Path, out: Path) -> tuple[bool, dict[str, Any] | None]:
    """Drive the same route under all conditions; return whether any run failed, and the summary's entry `speed`."""
    base = load_config(RunConfig, config, ["time=virtual"])
    axes = {"routes": [base.vehicle.route], "conditions": list(VIRTUAL_CONDITIONS)}
    planned_runs = plan_sweep(parse_config(SweepConfig, {**base.model_dump(mode="json"), **axes}, str(config)))
    from lavt.experiment.sweep.sweep import run_all  # noqa: PLC0415 (slow: scipy, matplotlib)

    with progress("virtual time, L0 to L5", len(planned_runs)) as report_done:
        sweep_result, speed = run_all(planned_runs, out / "runs", jobs=None, on_progress=report_done)
    return bool(sweep_result.failed), speed


def _print_table(summary: dict[str, Any]) -> None:
    """Print a table with one row for each run."""
    columns = ("time", "condition", "ending", "injected", "tau_v", "tau_c", "loop", "P95")
    units = ("", "", "", "video + control, ms", "ms", "ms", "ms", "cross-track, m")
    table = Table(*("\n".join(heading) for heading in zip(columns, units, strict=True)))
    for run in summary["runs"]:
        injected_ms = run["injected_ms"]
        table.add_row(
            run["time"],
            run["condition"],
            run["ending"] + ("" if run["valid"] else ", not valid"),
            f"{injected_ms['video']:g} + {injected_ms['control']:g}",
            _format_latency(run["tau_v_ms"]),
            _format_latency(run["tau_c_ms"]),
            _format_latency(run["loop_ms"]),
            "" if run["p95_m"] is None else f"{run['p95_m']:.2f}",
        )
    Console(width=120).print(table)


def _format_latency(summary: dict[str, Any]) -> str:
    if summary["p50"] is None:
        return "unknown"
    bound = summary.get("bound")
    return f"{summary['p50']:.1f}" + ("" if bound is None else f" ± {bound:.2f}")
