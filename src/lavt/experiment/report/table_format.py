"""Tables as data, with conversion to HTML for the page, CSV for computing, and LaTeX for papers."""

from __future__ import annotations

import csv
import io
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from lavt.experiment.report import html_page

NOTHING = "–"
UNBROKEN = "\N{NO-BREAK SPACE}"

SHARE = "share"
"""Unit of a share in CSV, where 1 is the whole; the page shows per cent."""

LOW_HIGH = ("low", "high")
PERCENTILES = ("p50", "p5", "p95")

TITLE_CHARACTERS = 14
"""A column title longer than this is broken into lines in LaTeX."""

LINE_CHARACTERS = 66
"""A table wider than a line of text in LaTeX's article class is scaled to the line's width."""

LONG_CHARACTERS, LONG_CM = 35, 6
"""In LaTeX, a text column with more than `LONG_CHARACTERS` characters is `LONG_CM` cm wide, with line breaks."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its title, and a function that formats the value of a cell.

    `parts` names the values of a cell that has several (a sequence, or a mapping with these keys); CSV has a column
    for each part. `in_csv` is the unit of the values in CSV if it differs from the unit shown. `is_text` marks a column
    of words, which is aligned left, and `is_long` a column of sentences.
    """

    title: str
    show: Callable[[Any], str]
    parts: tuple[str, ...] = ()
    is_text: bool = False
    is_long: bool = False
    in_csv: str = ""


@dataclass(frozen=True, slots=True)
class TableData:
    """A table: columns, and rows with a value for each column; None is an unknown value."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]]

    def without_empty(self) -> TableData:
        """Return the table without the columns that have no known value."""
        known = [
            index
            for index, column in enumerate(self.columns)
            if any(value is not None for row in self.rows for value in _values(column, row[index]))
        ]
        columns = [self.columns[index] for index in known]
        return TableData(columns, [[row[index] for index in known] for row in self.rows])


def texts(title: str, *, is_long: bool = False) -> Column:
    """Return a column of texts."""
    return Column(title, lambda cell: NOTHING if cell is None else str(cell), is_text=True, is_long=is_long)


def numbers(title: str, digits: int = 1) -> Column:
    """Return a column of numbers, shown with `digits` decimals."""
    return Column(title, lambda cell: number(cell, digits))


def shares(title: str) -> Column:
    """Return a column of shares, shown as whole per cent."""
    return Column(title, percent, in_csv=SHARE)


def share_intervals(title: str) -> Column:
    """Return a column of intervals of shares."""
    return Column(
        title,
        lambda cell: NOTHING if cell is None else f"{interval(cell, unit=100.0)}{UNBROKEN}%",
        LOW_HIGH,
        in_csv=SHARE,
    )


def intervals(title: str) -> Column:
    """Return a column of intervals, each with a low and a high bound."""
    return Column(title, lambda cell: interval(cell, digits=2), LOW_HIGH)


def probabilities(title: str) -> Column:
    """Return a column of p values."""
    return Column(title, probability)


def latencies(title: str, *, bounded: bool = False) -> Column:
    """Return a column of latencies in ms: `p5`, `p50`, `p95`, and `bound` if the clock offset enters them."""
    return Column(title, latency, (*PERCENTILES, "bound") if bounded else PERCENTILES)


def number(value: float | None, digits: int = 1) -> str:
    """Return a number with `digits` decimals, or a dash for None."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """Return a share in whole per cent, or a dash for None."""
    return NOTHING if value is None else f"{value * 100:.0f}{UNBROKEN}%"


def probability(value: float | None) -> str:
    """Return a p value with two significant digits, never as 0."""
    if value is None:
        return NOTHING
    return f"<{UNBROKEN}0.0001" if value < 0.0001 else f"{value:.2g}"


def interval(bounds: Sequence[float] | None, *, unit: float = 1.0, digits: int = 0) -> str:
    """Return an interval as "low to high", without a line break."""
    if bounds is None:
        return NOTHING
    return f"{bounds[0] * unit:.{digits}f} to {bounds[1] * unit:.{digits}f}".replace(" ", UNBROKEN)


def latency(summary: Mapping[str, Any] | None) -> str:
    """Return the median, the bound of its clock error (if there is one), and p5 to p95."""
    if summary is None or summary["p50"] is None:
        return NOTHING
    median, spread = f"{summary['p50']:.1f}", f"({summary['p5']:.1f} to {summary['p95']:.1f})"
    if "bound" in summary:
        median = with_bound(summary["p50"], summary["bound"])
    return f"{median} {spread.replace(' ', UNBROKEN)}"


def with_bound(value: float | None, bound: float | None, *, digits: int = 1) -> str:
    """Return a number ± its bound, without a line break; the bound has one decimal more, at most three."""
    if value is None:
        return NOTHING
    error = "unknown" if bound is None else f"{bound:.{min(digits + 1, 3)}f}"
    return f"{value:.{digits}f} ± {error}".replace(" ", UNBROKEN)


def html_of(table: TableData) -> Markup:
    """Return a table as HTML."""
    return html_page.table(table.columns, _texts(table))


def csv_of(table: TableData) -> str:
    """Return a table as CSV: each value in its own column with all its digits, an unknown value empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([name for column in table.columns for name in _names(column)])
    for row in table.rows:
        cells = zip(table.columns, row, strict=True)
        writer.writerow([_plain(value) for column, cell in cells for value in _values(column, cell)])
    return stream.getvalue()


def tex_of(table: TableData) -> str:
    r"""Return a table as a LaTeX `tabular`; it needs `booktabs`, and `graphicx` if it is wide."""
    shown = _texts(table)
    columns = [_tex_column(column, [row[index] for row in shown]) for index, column in enumerate(table.columns)]
    head, *rows = [" & ".join(cells) + r" \\" for cells in zip(*(cells for _, _, cells in columns), strict=True)]
    packages = [r"% needs \usepackage{booktabs}"]
    begin, end = rf"\begin{{tabular}}{{{''.join(align for align, _, _ in columns)}}}", r"\end{tabular}"
    if sum(width + 2 for _, width, _ in columns) > LINE_CHARACTERS:
        packages.append(r"% needs \usepackage{graphicx}")
        begin, end = r"\resizebox{\textwidth}{!}{" + begin, end + "}"
    return "\n".join([*packages, begin, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", end, ""])


def _tex_column(column: Column, texts: Sequence[str]) -> tuple[str, int, list[str]]:
    """Return a column's LaTeX alignment, its approximate width in characters, and its cells, the title first."""
    longest = max(map(len, texts), default=0)
    if column.is_text and longest > LONG_CHARACTERS:
        return f"p{{{LONG_CM}cm}}", LONG_CHARACTERS, [_tex(column.title), *map(_tex_long, texts)]
    align = "l" if column.is_text else "r"
    title = column.title.replace(" %", f"{UNBROKEN}%")
    lines = textwrap.wrap(title, TITLE_CHARACTERS, break_long_words=False) or [""]
    stack = r"\\".join(map(_tex, lines))
    title = stack if len(lines) == 1 else rf"\shortstack[{align}]{{{stack}}}"
    return align, max(longest, *map(len, lines)), [title, *map(_tex, texts)]


def _texts(table: TableData) -> list[list[str]]:
    return [[column.show(cell) for column, cell in zip(table.columns, row, strict=True)] for row in table.rows]


def _names(column: Column) -> list[str]:
    unit = f"({column.in_csv})" if column.in_csv else ""
    return [" ".join(filter(None, (column.title, part, unit))) for part in column.parts or ("",)]


def _values(column: Column, cell: Any) -> list[Any]:
    if not column.parts:
        return [cell]
    if cell is None:
        return [None] * len(column.parts)
    return [cell.get(part) for part in column.parts] if isinstance(cell, Mapping) else list(cell)


def _plain(value: Any) -> str:
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


_TEX = {
    "\\": r"\textbackslash{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"$<$",
    ">": r"$>$",
    "|": r"$|$",
    "[": "{[}",  # at the beginning of a row, LaTeX reads these as options of the line break before it
    "*": "{*}",
    "τ": r"$\tau$",
    "±": r"$\pm$",
    "°": r"$^\circ$",
    "–": "--",
    UNBROKEN: "~",
}


def _tex(text: str) -> str:
    """Escape LaTeX's special characters; a line break becomes a space, so that each row is one line."""
    return "".join(_TEX.get(character, character) for character in text.replace("\n", " "))


def _tex_long(text: str) -> str:
    """Escape a text, and permit line breaks after each comma and colon, as JSON has no spaces."""
    return re.sub(r"([,:])(?=[^\s~])", r"\1\\allowbreak{}", _tex(text))
