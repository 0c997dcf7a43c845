"""What a report leaves beside its page: each figure as SVG and PNG, each table as CSV and LaTeX."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from lavt.experiment.report import html_page
from lavt.experiment.report.table_format import TableData, csv_of, html_of, tex_of

RESOLUTION_DPI = 120

LARGEST_SHOWN_BYTES = 400_000
"""A larger SVG is slow on a phone: the page shows the PNG then, and links to both."""

SHORT_ROWS = 30
"""A longer table may be cut by the end of a printed page, with its head on each."""

_SVG: Any = {"svg.hashsalt": "lavt", "svg.fonttype": "none", "path.simplify_threshold": 0.3}
"""The same figure gives the same bytes; text stays text."""

_NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}


def save_figure(report_dir: Path, name: str, figure: Figure, alternative: str, caption: str) -> str:
    """Write a figure as `name`.png and `name`.svg, and return the HTML that shows it."""
    png, svg = report_dir / f"{name}.png", report_dir / f"{name}.svg"
    with mpl.rc_context(_SVG):
        figure.savefig(png, dpi=RESOLUTION_DPI, metadata={"Software": None})
        figure.set_layout_engine("none")  # it is laid out by now, which takes as long as drawing it
        figure.savefig(svg, metadata=_NO_METADATA)
    shown = svg if svg.stat().st_size <= LARGEST_SHOWN_BYTES else png
    return html_page.picture(shown.name, [svg.name, png.name], alternative, caption)


def save_table(report_dir: Path, name: str, table: TableData) -> str:
    """Write a table as tables/`name`.csv and .tex, and return the HTML that shows it; nothing for one without rows."""
    if not table.rows:
        return ""
    return html_page.table(
        html_of(table), _write_table(report_dir, name, table), is_short=len(table.rows) <= SHORT_ROWS
    )


def link_table(report_dir: Path, name: str, table: TableData) -> str:
    """Write a table that is too long for the page, and return the HTML that links to it."""
    return html_page.table("", _write_table(report_dir, name, table), is_short=True) if table.rows else ""


def _write_table(report_dir: Path, name: str, table: TableData) -> list[str]:
    directory = report_dir / "tables"
    directory.mkdir(exist_ok=True)
    (directory / f"{name}.csv").write_text(csv_of(table), encoding="utf-8")
    (directory / f"{name}.tex").write_text(tex_of(table), encoding="utf-8")
    return [f"tables/{name}.csv", f"tables/{name}.tex"]
