"""The files of a report: each figure as SVG and PNG, each table as CSV and LaTeX, with links on the page."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.figure import Figure

from lavt.experiment.report import html_page
from lavt.experiment.report.table_format import TableData, csv_of, html_of, tex_of

RESOLUTION_DPI = 250

LARGEST_SHOWN_BYTES = 300_000
"""If the SVG of a figure is larger than this, the page shows the PNG, because a phone renders a large SVG slowly."""

_DARK = "".join(
    f'[style*="{name}: {light}"]{{{name}:{dark}!important}}'
    for light, dark in {"#ffffff": "#14171a", "#000000": "#e4e7ea", "#b0b0b0": "#59626b", "#4d4d4d": "#b5bcc4"}.items()
    for name in ("fill", "stroke")
)
DARK_STYLE = f"<style>@media (prefers-color-scheme:dark){{text{{fill:#e4e7ea}}{_DARK}}}</style>"
"""Exchanges background and ink of a figure on a dark page. The colours of conditions remain."""

SHORT_ROWS = 30
"""A table with more rows can be split between printed pages; its head is then repeated on each page."""

_SVG_SETTINGS: Any = {"svg.hashsalt": "lavt", "svg.fonttype": "none", "path.simplify_threshold": 0.3}
"""With these settings the SVG of a figure is byte-for-byte reproducible, and its texts are stored as text."""

_NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}


def save_figure(report_dir: Path, name: str, figure: Figure, alternative: str, caption: str) -> Markup:
    """Write `name`.png and `name`.svg, and return the figure as HTML; the text `alternative` describes the figure."""
    png, svg = report_dir / f"{name}.png", report_dir / f"{name}.svg"
    with mpl.rc_context(_SVG_SETTINGS):
        figure.savefig(png, dpi=RESOLUTION_DPI, metadata={"Software": None})
        figure.set_layout_engine("none")  # keep the layout: to compute it again takes as long as drawing the figure
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata=_NO_METADATA)
    svg.write_text(text.getvalue().replace("</style>", f"</style>{DARK_STYLE}", 1), encoding="utf-8")
    shown = svg if svg.stat().st_size <= LARGEST_SHOWN_BYTES else png
    return html_page.figure(shown, [svg.name, png.name], alternative, caption)


def save_table(report_dir: Path, name: str, table: TableData) -> Markup:
    """Write tables/`name`.csv and .tex, and return the table as HTML; if it has no rows, write and return nothing."""
    return _save_table(report_dir, name, table, html_of(table), is_short=len(table.rows) <= SHORT_ROWS)


def link_table(report_dir: Path, name: str, table: TableData) -> Markup:
    """Write a table that is too long for the page, and return only links to its files as HTML."""
    return _save_table(report_dir, name, table, Markup(), is_short=True)  # on the page: the links only


def _save_table(report_dir: Path, name: str, table: TableData, html: Markup, *, is_short: bool) -> Markup:
    if not table.rows:
        return Markup()
    directory = report_dir / "tables"
    directory.mkdir(exist_ok=True)
    (directory / f"{name}.csv").write_text(csv_of(table), encoding="utf-8")
    (directory / f"{name}.tex").write_text(tex_of(table), encoding="utf-8")
    return html_page.linked_table(html, [f"tables/{name}.csv", f"tables/{name}.tex"], is_short=is_short)
