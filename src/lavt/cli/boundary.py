"""`lavt boundary`: the maximum total latency that a control loop tolerates."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.cli import console
from lavt.cli.progress import progress
from lavt.config import BoundaryConfig
from lavt.config_file import load_config
from lavt.errors import WorkError
from lavt.recording.output_directory import check_output, disk_errors_named, make_directory, reserve_directory


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("boundary")(boundary)


def boundary(
    config: Annotated[Path, typer.Argument(help="A boundary config in YAML, such as configs/boundary.yaml.")],
    changes: console.SetOption = None,
    out: console.OutOption = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of parallel searches; default: one per core.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped search in --out.")] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Find the maximum tolerable latency.

    The search finds the smallest total delays at which an oscillation grows (onset), the car leaves its lane
    (departure), and the car no longer completes the route (completion). It compares the onset with theory. Finished
    searches of a stopped command are kept; see --resume.

    Example: lavt boundary configs/boundary.yaml --set 'routes=[a_key]' --out out/boundary
    """
    from lavt.experiment.boundary.boundary import plan_boundary, search_boundary  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.boundary.boundary_files import BOUNDARY_CONFIG, read_found  # noqa: PLC0415

    settings = load_config(BoundaryConfig, config, changes or [])
    searches = plan_boundary(settings)
    out = out or Path("out") / "boundary"
    check_output(out, BOUNDARY_CONFIG, resume=resume)
    make_directory(out)
    found = read_found(out)
    remaining = sum(search.key not in found for search in searches)
    with (
        reserve_directory(out),
        console.interruptible("searches"),
        disk_errors_named(out),
        progress(f"boundary search, results in {out}", remaining) as report_done,
    ):
        result, is_complete = search_boundary(settings, searches, out, jobs=jobs, on_progress=report_done)
    for failure in result["failed"]:
        console.print_message(f"failed: {failure['name']}: {failure['why']}")
    if not is_complete:
        raise WorkError(f"stopped; the results so far are in {out}: continue with --resume")
    if as_json:
        console.print_json(result)
    else:
        for line in _table_lines(result):
            console.print_result(line)
        console.print_result(f"boundary.json, .csv, .svg and .png are in {out}")
    if result["failed"]:
        raise typer.Exit(1)


def _table_lines(result: dict[str, Any]) -> list[str]:
    """Return the lines of a table with the median and interval of each criterion, for each route and preset."""
    from lavt.experiment.report.boundary_section import ALL_ROUTES, format_ends  # noqa: PLC0415 (slow: matplotlib)
    from lavt.experiment.report.table_format import format_number  # noqa: PLC0415 (a part of the slow report)
    from lavt.experiment.statistics.boundary_summary import CRITERIA  # noqa: PLC0415 (slow: scipy)

    table = [("route", "preset", "seeds", "theory", *CRITERIA)]
    for group in result["groups"]:
        cells = []
        for name in CRITERIA:
            summary = group[f"{name}_ms"]
            cells.append(f"{format_number(summary['p50'], 0)} ({format_ends(summary['interval'])})")
        table.append(
            (
                group["route"] or ALL_ROUTES,
                group["preset"],
                str(group["n"]),
                format_number(group["theory_ms"], 0),
                *cells,
            )
        )
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table]
