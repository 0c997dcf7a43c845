"""The section of a report on the maximum tolerable latency, as `lavt boundary` finds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lavt.experiment.report import html_page
from lavt.experiment.report.boundary_figure import boundary_figure, boundary_table
from lavt.experiment.report.files import save_figure, save_table
from lavt.experiment.report.sections import Parts
from lavt.experiment.report.sentences import boundary_sentences


def boundary_parts(boundaries: Sequence[Mapping[str, Any]], report_dir: Path) -> Parts:
    """Return the sentences, the figure and the table of each boundary, the contents of a `boundary.json`."""
    parts = []
    for number, boundary in enumerate(boundaries, start=1):
        name = "boundary" if len(boundaries) == 1 else f"boundary_{number}"
        caption = (
            "Total delay, from the middle of the exposure to the wheel's command, at which an oscillation begins to "
            "grow, the vehicle first leaves its lane, and the route is no longer completed. Ticks are seeds, a large "
            "point and its bar are the median and its 95 % interval, and the dashed line is the onset predicted by "
            "theory."
        )
        parts.append(html_page.bullets(boundary_sentences(boundary["groups"])))
        figure = boundary_figure(boundary)
        parts.append(save_figure(report_dir, name, figure, "maximum tolerable latency compared with theory", caption))
        parts.append(save_table(report_dir, name, boundary_table(boundary)))
    if parts:
        parts.append(
            html_page.paragraph(
                "Completion does not measure stability: a run can be completed although its oscillation grows.",
                is_note=True,
            )
        )
    return parts
