"""A table as data, and what can be made of it: HTML to read, CSV to compute with, LaTeX to paste."""

from __future__ import annotations

import csv
import io
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

NOTHING = "–"
UNBROKEN = "\N{NO-BREAK SPACE}"

SHARE = "share"
"""In CSV a share is a part of 1."""

LOW_HIGH = ("low", "high")
PERCENTILES = ("p50", "p5", "p95")

TITLE_CHARACTERS = 14
"""A longer title of a column is broken into lines in LaTeX, where a page has an end."""

LINE_CHARACTERS = 66
"""A wider table is made as narrow as the text in LaTeX: so many are in a line of its article."""

LONG_CHARACTERS, LONG_CM = 35, 6
"""A column of texts of which one is longer is broken into lines of so many centimetres in LaTeX."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its title, and how a cell's value is shown as text.

    `parts` names the values that a cell consists of, where it has several (a sequence, or a mapping with these keys):
    CSV has a column for each of them. `in_csv` is the unit of its values in CSV, where they are shown in another one.
    `is_text` is for words, which begin at the left; `is_long` for sentences.
    """

    title: str
    show: Callable[[Any], str]
    parts: tuple[str, ...] = ()
    is_text: bool = False
    is_long: bool = False
    in_csv: str = ""


@dataclass(frozen=True, slots=True)
class TableData:
    """Columns, and rows of values, as many as there are columns; None is what is not known."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]]

    def without_empty(self) -> TableData:
        """Leave out the columns of which no row knows a value."""
        known = [
            index
            for index, column in enumerate(self.columns)
            if any(value is not None for row in self.rows for value in _values(column, row[index]))
        ]
        columns = [self.columns[index] for index in known]
        return TableData(columns, [[row[index] for index in known] for row in self.rows])


def words(title: str, *, is_long: bool = False) -> Column:
    """Make a column of texts."""
    return Column(title, lambda cell: NOTHING if cell is None else str(cell), is_text=True, is_long=is_long)


def numbers(title: str, digits: int = 1) -> Column:
    """Make a column of numbers, shown with `digits` after the point."""
    return Column(title, lambda cell: number(cell, digits))


def shares(title: str) -> Column:
    """Make a column of shares of 1, shown as whole per cent."""
    return Column(title, percent, in_csv=SHARE)


def share_intervals(title: str) -> Column:
    """Make a column of intervals of shares of 1."""
    return Column(
        title,
        lambda cell: NOTHING if cell is None else f"{interval(cell, unit=100.0)}{UNBROKEN}%",
        LOW_HIGH,
        in_csv=SHARE,
    )


def intervals(title: str, digits: int = 2) -> Column:
    """Make a column of intervals, each a low and a high bound."""
    return Column(title, lambda cell: interval(cell, digits=digits), LOW_HIGH)


def probabilities(title: str) -> Column:
    """Make a column of p values."""
    return Column(title, probability)


def latencies(title: str, *, bounded: bool = False) -> Column:
    """Make a column of latencies in ms: `p5`, `p50`, `p95`, and `bound` where the offset between clocks matters."""
    return Column(title, latency, (*PERCENTILES, "bound") if bounded else PERCENTILES)


def number(value: float | None, digits: int = 1) -> str:
    """Write a number with `digits` after the point; a dash where there is none."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """Write a share as whole per cent."""
    return NOTHING if value is None else f"{value * 100:.0f}{UNBROKEN}%"


def probability(value: float | None) -> str:
    """Write a p value with two significant digits, never as 0."""
    if value is None:
        return NOTHING
    return f"<{UNBROKEN}0.0001" if value < 0.0001 else f"{value:.2g}"


def interval(bounds: Sequence[float] | None, *, unit: float = 1.0, digits: int = 0) -> str:
    """Write an interval as "low to high", not to be broken."""
    if bounds is None:
        return NOTHING
    return f"{bounds[0] * unit:.{digits}f} to {bounds[1] * unit:.{digits}f}".replace(" ", UNBROKEN)


def latency(summary: Mapping[str, Any] | None) -> str:
    """Write a latency: median, the bound of what the clocks can make of it (not of a loop), and p5 to p95."""
    if summary is None or summary["p50"] is None:
        return NOTHING
    median, spread = f"{summary['p50']:.1f}", f"({summary['p5']:.1f} to {summary['p95']:.1f})"
    if "bound" in summary:
        median = with_bound(summary["p50"], summary["bound"])
    return f"{median} {spread.replace(' ', UNBROKEN)}"


def with_bound(value: float | None, bound: float | None, *, digits: int = 1) -> str:
    """Write a number with how wrong it can be (one digit more, at most three), not to be broken."""
    if value is None:
        return NOTHING
    wrong = "unknown" if bound is None else f"{bound:.{min(digits + 1, 3)}f}"
    return f"{value:.{digits}f} ± {wrong}".replace(" ", UNBROKEN)


def html_of(table: TableData) -> str:
    """Make HTML of a table, which scrolls sideways on a narrow screen."""
    kinds = [
        ' class="long"' if column.is_long else ' class="text"' if column.is_text else "" for column in table.columns
    ]
    head = "".join(f"<th{kind}>{escape(column.title)}</th>" for kind, column in zip(kinds, table.columns, strict=True))
    body = "\n".join(
        "<tr>" + "".join(f"<td{kind}>{escape(text)}</td>" for kind, text in zip(kinds, texts, strict=True)) + "</tr>"
        for texts in _texts(table)
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def csv_of(table: TableData) -> str:
    """Make CSV of a table: every value in a column of its own, to its last digit; nothing where it is not known."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([name for column in table.columns for name in _names(column)])
    for row in table.rows:
        cells = zip(table.columns, row, strict=True)
        writer.writerow([_plain(value) for column, cell in cells for value in _values(column, cell)])
    return stream.getvalue()


def tex_of(table: TableData) -> str:
    r"""Make a LaTeX `tabular` of a table, as it is shown; needs `booktabs`, and `graphicx` where it is wide."""
    texts = _texts(table)
    columns = [_tex_column(column, [row[index] for row in texts]) for index, column in enumerate(table.columns)]
    head, *rows = [" & ".join(cells) + r" \\" for cells in zip(*(cells for _, _, cells in columns), strict=True)]
    packages = [r"% needs \usepackage{booktabs}"]
    begin, end = rf"\begin{{tabular}}{{{''.join(place for place, _, _ in columns)}}}", r"\end{tabular}"
    if sum(width + 2 for _, width, _ in columns) > LINE_CHARACTERS:
        packages.append(r"% needs \usepackage{graphicx}")
        begin, end = r"\resizebox{\textwidth}{!}{" + begin, end + "}"
    return "\n".join([*packages, begin, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", end, ""])


def _tex_column(column: Column, texts: Sequence[str]) -> tuple[str, int, list[str]]:
    """Give a column's place in LaTeX, about how many characters wide it is, and its cells, the title first."""
    longest = max(map(len, texts), default=0)
    if column.is_text and longest > LONG_CHARACTERS:
        return f"p{{{LONG_CM}cm}}", LONG_CHARACTERS, [_tex(column.title), *map(_tex_long, texts)]
    place = "l" if column.is_text else "r"
    title = column.title.replace(" %", f"{UNBROKEN}%")
    lines = textwrap.wrap(title, TITLE_CHARACTERS, break_long_words=False) or [""]
    stack = r"\\".join(map(_tex, lines))
    title = stack if len(lines) == 1 else rf"\shortstack[{place}]{{{stack}}}"
    return place, max(longest, *map(len, lines)), [title, *map(_tex, texts)]


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
    "[": "{[}",  # after a row, these would be read as the height of a space, and as a star
    "*": "{*}",
    "τ": r"$\tau$",
    "±": r"$\pm$",
    "°": r"$^\circ$",
    "–": "--",
    UNBROKEN: "~",
}


def _tex(text: str) -> str:
    """Escape what LaTeX would read as a command; a line break ends a table's row there, so it becomes a space."""
    return "".join(_TEX.get(character, character) for character in text.replace("\n", " "))


def _tex_long(text: str) -> str:
    """Escape a text that may be broken where JSON has no spaces, too."""
    return re.sub(r"([,:])(?=[^\s~])", r"\1\\allowbreak{}", _tex(text))
