"""`lavt run`: execute one run on this machine."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from lavt.cli import console
from lavt.cli.live_view import LiveView
from lavt.cli.page import show_page
from lavt.config import RunConfig
from lavt.config_file import load_config
from lavt.errors import UserError
from lavt.experiment.runs.netem_run import check_netem
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.runs.run import run_once
from lavt.recording.output_directory import check_directory, disk_errors_named
from lavt.transport.console.console_link import check_installed


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("run")(run)


def run(
    config: Annotated[Path, typer.Argument(help="A run config in YAML, such as configs/demo.yaml.")],
    changes: console.SetOption = None,
    out: console.OutOption = None,
    watches: console.WatchOption = False,
    opens_page: console.BrowserOption = True,
    as_json: console.JsonOption = False,
) -> None:
    """Drive one route under one network condition.

    The run is in virtual or real time, as the config says. With `--watch`, in real time only, a page in the browser
    shows the video and the lane that the controller detects.

    Example: lavt run configs/demo.yaml --set network.condition=L2 --out out/l2
    """
    planned_run = plan_run(load_config(RunConfig, config, changes or []))
    if watches:
        _check_watch(planned_run)
    out = out or Path("out") / "run"
    check_directory(out)
    with console.interruptible():
        for message in check_netem(planned_run):
            console.print_message(f"lavt: {message}")
    title = f"driving {planned_run.config.vehicle.route} under {planned_run.config.network.condition}"
    with (
        console.interruptible(),
        TemporaryDirectory(prefix="lavt-") as work,
        LiveView(title) as view,
        disk_errors_named(out),
    ):

        def show(url: str) -> None:
            show_page(url, Path(work), opens_page=opens_page, purpose="watch at")

        result = run_once(planned_run, out, progress=view.update, watch=show if watches else None)
    print_run(result, out, planned_run.config.seed, as_json=as_json)


def _check_watch(planned_run: PlannedRun) -> None:
    if planned_run.config.time != "real":
        raise UserError("a run in virtual time cannot be watched: add --set time=real, or leave out --watch")
    check_installed()


def print_run(result: dict[str, Any], out: Path, seed: int, *, as_json: bool) -> None:
    """Print the result of a run with the config's seed, as JSON or as text with the run's directory."""
    if as_json:
        console.print_json(result)
    else:
        console.print_result(_summarize(result, seed))
        console.print_result(f"records and result.json are in {out}")


def _summarize(result: dict[str, Any], seed: int) -> str:
    """Return a summary of a run in a few lines."""
    loop_ms, frame_age_ms = result["loop_ms"], result["picture_age_ms"]
    lines = [
        f"{result['route']} under {result['condition']}, seed {seed}: {result['ending']} after "
        f"{_format_number(result['distance_m'], 'm')}, cross-track P95 {_format_number(result['p95_m'], 'm', 2)}",
        f"loop latency {_format_number(loop_ms['p50'], 'ms')} (p95 {_format_number(loop_ms['p95'], 'ms')}), "
        f"mean frame age {_format_number(frame_age_ms['mean'], 'ms')}",
        f"tau_v {_format_latency(result['tau_v_ms'])}, tau_c {_format_latency(result['tau_c_ms'])}",
    ]
    if not result["valid"]:
        lines.append("this run is not valid: " + "; ".join(reason["text"] for reason in result["invalid_reasons"]))
    return "\n".join(lines)


def _format_latency(summary: dict[str, Any]) -> str:
    if summary["p50"] is None:
        return "unknown"
    bound = "no known bound" if summary["bound"] is None else f"± {summary['bound']:.2f} ms"
    return f"{summary['p50']:.1f} ms ({bound})"


def _format_number(value: float | None, unit: str, digits: int = 1) -> str:
    return "unknown" if value is None else f"{value:.{digits}f} {unit}"
