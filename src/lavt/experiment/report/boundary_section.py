"""The section of a report that shows what `lavt boundary` found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lavt.experiment.report import html_page
from lavt.experiment.report.boundary_figure import boundary_figure, boundary_table
from lavt.experiment.report.files import save_figure, save_table
from lavt.experiment.report.sentences import boundary_sentences


def boundary_parts(boundaries: Sequence[Mapping[str, Any]], report_dir: Path) -> list[str]:
    """Show each boundary, the contents of a `boundary.json`, as a figure and a table."""
    parts = []
    for number, boundary in enumerate(boundaries, start=1):
        name = "boundary" if len(boundaries) == 1 else f"boundary_{number}"
        caption = (
            "Total delay, middle of exposure to the wheel's command, at which a swing begins to grow, the car first "
            "leaves its lane, and the route is no longer completed: ticks are seeds, a large point and its bar the "
            "median and its 95 % interval, the dashed line the onset by theory."
        )
        parts.append(html_page.bullets(boundary_sentences(boundary["groups"])))
        figure = boundary_figure(boundary)
        parts.append(save_figure(report_dir, name, figure, "boundaries beside theory", caption))
        parts.append(save_table(report_dir, name, boundary_table(boundary)))
    if parts:
        parts.append(
            html_page.paragraph(
                "Completion does not measure stability: a swing that grows may not have the room to end a run.",
                note=True,
            )
        )
    return parts
