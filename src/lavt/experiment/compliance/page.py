"""The page of the compliance report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
from markupsafe import Markup

from lavt.experiment.compliance import sentences, tables
from lavt.experiment.compliance.figures import drive_figure, exceedance_figure
from lavt.experiment.compliance.fleet import condition_name
from lavt.experiment.report import html_page
from lavt.experiment.report.figures.figure_style import SETTINGS, condition_colours
from lavt.experiment.report.files import link_table, save_figure, save_table
from lavt.experiment.report.table_format import html_of

if TYPE_CHECKING:
    from lavt.experiment.compliance.compliance import FleetCompliance

TITLE = "LAVT: latency compliance report"
MAX_ROWS = 60
"""A longer table of outages is only linked."""


def write_page(fleet: FleetCompliance, content: tables.Content, out: Path, files: tuple[str, ...]) -> Path:
    """Write the page with its figures and tables into `out`, and return its path; `files` have all numbers."""
    with mpl.rc_context(SETTINGS):
        first, chapters = _first_parts(fleet, content, out), _chapters(content, out, files)
    page = out / "index.html"
    page.write_text(html_page.page(TITLE, first, chapters), encoding="utf-8")
    return page


def _first_parts(fleet: FleetCompliance, content: tables.Content, out: Path) -> list[Markup]:
    limit_ms = content["limit_ms"]
    drives = fleet.drives
    colours = condition_colours(condition_name(drive.entry) for drive in drives)
    worst = max(drives, key=lambda drive: (drive.entry["above_share"], drive.entry["manoeuvres"]))
    exceedance = save_figure(
        out,
        "exceedance",
        exceedance_figure(drives, colours, limit_ms),
        "share of time above a latency",
        "Share of the commanded time in which the latency was above the value on the horizontal axis, by condition. "
        "Both figures show the lower bounds.",
    )
    over_time = save_figure(
        out,
        "drive",
        drive_figure(worst, limit_ms),
        "latency and speed over time",
        "Above: frame age and two-way latency. Below: speed, and the speed that the latency allowed."
        + (" This is the drive with the largest share of time above the limit." if len(drives) > 1 else ""),
    )
    return [
        html_page.paragraph(f"{sentences.NO_CERTIFICATION} {' '.join(sentences.setting_sentences(content))}"),
        html_page.bullets(sentences.finding_sentences(content)),
        html_page.figures([exceedance, over_time]),
        html_page.terms(sentences.terms(content)),
    ]


def _chapters(content: tables.Content, out: Path, files: tuple[str, ...]) -> list[html_page.Chapter]:
    outages = tables.outage_table(content)
    save_outages = save_table if len(outages.rows) <= MAX_ROWS else link_table
    every_drive = html_of(tables.drive_table(content))
    return [
        html_page.Chapter(
            "Verdicts",
            [
                ("Criteria", [save_table(out, "criteria", tables.criteria_table(content))]),
                ("Totals", [save_table(out, "totals", tables.totals_table(content))]),
            ],
            is_open=True,
        ),
        html_page.Chapter(
            "Drives",
            [
                ("Every drive", [html_page.linked_table(every_drive, files, is_short=False)]),
                ("Drives that do not count", [save_table(out, "excluded", tables.excluded_table(content))]),
            ],
            is_open=True,
        ),
        html_page.Chapter(
            "Stops and outages",
            [
                ("Minimal-risk manoeuvres", [save_table(out, "manoeuvres", tables.manoeuvre_table(content))]),
                ("Outages", [save_outages(out, "outages", outages)]),
            ],
            is_open=True,
        ),
    ]
