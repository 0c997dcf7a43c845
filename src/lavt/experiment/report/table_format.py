"""Tables as data, and their conversion to HTML for the page, CSV for other programs, and LaTeX for papers."""

from __future__ import annotations

import csv
import io
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from markupsafe import Markup

from lavt.experiment.report import html_page

NOTHING = "–"
"""The text of a cell without a value."""
UNBROKEN = "\N{NO-BREAK SPACE}"

SHARE = "share"
"""The unit of a share in CSV, where 1 is the whole. The page shows per cent instead."""

LOW_HIGH = ("low", "high")
BY_ROAD = ("mean", "low", "high", "roads")
PERCENTILES = ("p50", "p5", "p95")

TITLE_CHARACTERS = 14
"""In LaTeX, a longer column title is broken into lines."""

TEX_LINE_CHARACTERS = 66
"""The number of characters in a line of LaTeX's article class. A wider table is scaled to the width of the line."""

LONG_CHARACTERS = 35
LONG_WIDTH_CM = 6
"""In LaTeX, a text column with a longer text than `LONG_CHARACTERS` is `LONG_WIDTH_CM` wide, with line breaks."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its title, and the function `show` that formats the value of a cell.

    If a cell has several values (a sequence, or a mapping), `parts` has their names or keys, and CSV has a column for
    each of them. `csv_unit` is the unit of the values in CSV if it differs from the unit on the page. `is_text` marks a
    column of words, which is aligned left, and `is_long` a column of sentences. The page shows an `is_extra` column
    only on demand.
    """

    title: str
    show: Callable[[Any], str]
    parts: tuple[str, ...] = ()
    is_text: bool = False
    is_long: bool = False
    csv_unit: str = ""
    is_extra: bool = False


@dataclass(frozen=True, slots=True)
class TableData:
    """A table: columns, and rows with a value for each column; None is an unknown value."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]]

    def without_empty_columns(self) -> TableData:
        """Return the table without the columns that have no known value."""
        known = [
            index
            for index, column in enumerate(self.columns)
            if any(value is not None for row in self.rows for value in _values(column, row[index]))
        ]
        columns = [self.columns[index] for index in known]
        return TableData(columns, [[row[index] for index in known] for row in self.rows])


def table_of_entries(entries: Iterable[Mapping[str, Any]], columns: Sequence[tuple[Column, str]]) -> TableData:
    """Return the table with a row for each entry, without empty columns.

    `columns` has each column with the key of its values in an entry; "a.b" is the key `b` of the nested entry `a`.
    """
    rows = [[_nested_value(entry, key) for _, key in columns] for entry in entries]
    return TableData([column for column, _ in columns], rows).without_empty_columns()


def _nested_value(entry: Mapping[str, Any], key: str) -> Any:
    value: Any = entry
    for name in key.split("."):
        value = (value or {}).get(name)
    return value


def extra(column: Column) -> Column:
    """Return the column as one that the page shows only on demand."""
    return replace(column, is_extra=True)


def text_column(title: str, *, is_long: bool = False) -> Column:
    """Return a column of texts."""
    return Column(title, lambda cell: NOTHING if cell is None else str(cell), is_text=True, is_long=is_long)


def number_column(title: str, digits: int = 1) -> Column:
    """Return a column of numbers, shown with `digits` decimals."""
    return Column(title, lambda cell: format_number(cell, digits))


def share_column(title: str) -> Column:
    """Return a column of shares, shown as whole per cent."""
    return Column(title, format_percent, csv_unit=SHARE)


def share_interval_column(title: str) -> Column:
    """Return a column of intervals of shares."""
    return Column(
        title,
        lambda cell: NOTHING if cell is None else f"{format_interval(cell, scale=100.0)}{UNBROKEN}%",
        LOW_HIGH,
        csv_unit=SHARE,
    )


def interval_column(title: str) -> Column:
    """Return a column of intervals, each with a low and a high bound."""
    return Column(title, lambda cell: format_interval(cell, digits=2), LOW_HIGH)


def by_road_column(title: str, *, digits: int = 2, is_share: bool = False) -> Column:
    """Return a column of values by road: the mean over roads with its interval, or with the number of too few roads."""
    return Column(
        title,
        lambda cell: format_by_road(cell, digits=digits, is_share=is_share),
        BY_ROAD,
        csv_unit=SHARE if is_share else "",
    )


def format_by_road(cell: Mapping[str, Any] | None, *, digits: int = 2, is_share: bool = False) -> str:
    """Return the mean over roads, and its interval or, if there is none, the number of roads."""
    if cell is None or cell["mean"] is None:
        return NOTHING
    scale, unit = (100.0, f"{UNBROKEN}%") if is_share else (1.0, "")
    shown = f"{cell['mean'] * scale:.{0 if is_share else digits}f}{unit}"
    if cell["low"] is None:
        roads = "1 road" if cell["roads"] == 1 else f"{cell['roads']} roads"
        return f"{shown} (no interval, {roads})".replace(" ", UNBROKEN)
    interval = format_interval((cell["low"], cell["high"]), scale=scale, digits=0 if is_share else digits)
    return f"{shown}{UNBROKEN}({interval}{unit})"


def probability_column(title: str) -> Column:
    """Return a column of p values."""
    return Column(title, format_probability)


def latency_column(title: str, *, bounded: bool = False) -> Column:
    """Return a column of latencies in ms.

    A cell has `p5`, `p50` and `p95`, and with `bounded` also `bound`, the error that the clock offset can cause.
    """
    return Column(title, format_latency, (*PERCENTILES, "bound") if bounded else PERCENTILES)


def format_number(value: float | None, digits: int = 1) -> str:
    """Return a number with `digits` decimals, or a dash for None."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def format_percent(value: float | None) -> str:
    """Return a share in whole per cent, or a dash for None."""
    return NOTHING if value is None else f"{value * 100:.0f}{UNBROKEN}%"


def format_probability(value: float | None) -> str:
    """Return a p value with two significant digits, never as 0."""
    if value is None:
        return NOTHING
    return f"<{UNBROKEN}0.0001" if value < 0.0001 else f"{value:.2g}"


def format_interval(bounds: Sequence[float] | None, *, scale: float = 1.0, digits: int = 0) -> str:
    """Return an interval, multiplied by `scale`, as "low to high" without a line break."""
    if bounds is None:
        return NOTHING
    low, high = bounds
    return f"{low * scale:.{digits}f} to {high * scale:.{digits}f}".replace(" ", UNBROKEN)


def format_latency(summary: Mapping[str, Any] | None) -> str:
    """Return the median, the bound of its clock error (if the summary has a bound), and the range from p5 to p95."""
    if summary is None or summary["p50"] is None:
        return NOTHING
    median, spread = f"{summary['p50']:.1f}", f"({summary['p5']:.1f} to {summary['p95']:.1f})"
    if "bound" in summary:
        median = format_with_bound(summary["p50"], summary["bound"])
    return f"{median} {spread.replace(' ', UNBROKEN)}"


def format_with_bound(value: float | None, bound: float | None, *, digits: int = 1) -> str:
    """Return a number ± its bound, without a line break.

    The bound has one decimal more than the number, but at most three decimals.
    """
    if value is None:
        return NOTHING
    error = "unknown" if bound is None else f"{bound:.{min(digits + 1, 3)}f}"
    return f"{value:.{digits}f} ± {error}".replace(" ", UNBROKEN)


def html_of(table: TableData, extra_note: str = "") -> Markup:
    """Return a table as HTML; the page shows `extra_note` only together with the extra columns."""
    return html_page.table(table.columns, _shown_texts(table), extra_note)


def csv_of(table: TableData) -> str:
    """Return a table as CSV.

    Each value has a column of its own and all its digits; the cell of an unknown value is empty.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([name for column in table.columns for name in _csv_names(column)])
    for row in table.rows:
        cells = zip(table.columns, row, strict=True)
        writer.writerow([_csv_text(value) for column, cell in cells for value in _values(column, cell)])
    return stream.getvalue()


def tex_of(table: TableData) -> str:
    r"""Return a table as a LaTeX `tabular`, which needs `booktabs` and, if the table is wide, `graphicx`."""
    shown = _shown_texts(table)
    columns = [_tex_column(column, [row[index] for row in shown]) for index, column in enumerate(table.columns)]
    head, *rows = [" & ".join(cells) + r" \\" for cells in zip(*(cells for _, _, cells in columns), strict=True)]
    packages = [r"% needs \usepackage{booktabs}"]
    begin, end = rf"\begin{{tabular}}{{{''.join(align for align, _, _ in columns)}}}", r"\end{tabular}"
    if sum(width + 2 for _, width, _ in columns) > TEX_LINE_CHARACTERS:
        packages.append(r"% needs \usepackage{graphicx}")
        begin, end = r"\resizebox{\textwidth}{!}{" + begin, end + "}"
    return "\n".join([*packages, begin, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", end, ""])


def _tex_column(column: Column, texts: Sequence[str]) -> tuple[str, int, list[str]]:
    """Return a column's LaTeX alignment, its approximate width in characters, and its cells, the title first."""
    longest = max(map(len, texts), default=0)
    if column.is_text and longest > LONG_CHARACTERS:
        return f"p{{{LONG_WIDTH_CM}cm}}", LONG_CHARACTERS, [_tex(column.title), *map(_tex_long, texts)]
    align = "l" if column.is_text else "r"
    title = column.title.replace(" %", f"{UNBROKEN}%")
    lines = textwrap.wrap(title, TITLE_CHARACTERS, break_long_words=False) or [""]
    joined_lines = r"\\".join(map(_tex, lines))
    title = joined_lines if len(lines) == 1 else rf"\shortstack[{align}]{{{joined_lines}}}"
    return align, max(longest, *map(len, lines)), [title, *map(_tex, texts)]


def _shown_texts(table: TableData) -> list[list[str]]:
    return [[column.show(cell) for column, cell in zip(table.columns, row, strict=True)] for row in table.rows]


def _csv_names(column: Column) -> list[str]:
    unit = f"({column.csv_unit})" if column.csv_unit else ""
    return [" ".join(filter(None, (column.title, part, unit))) for part in column.parts or ("",)]


def _values(column: Column, cell: Any) -> list[Any]:
    if not column.parts:
        return [cell]
    if cell is None:
        return [None] * len(column.parts)
    return [cell.get(part) for part in column.parts] if isinstance(cell, Mapping) else list(cell)


def _csv_text(value: Any) -> str:
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


_TEX = {
    "\\": r"\textbackslash{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"$<$",
    ">": r"$>$",
    "|": r"$|$",
    "[": "{[}",  # at the beginning of a row, LaTeX would read [ or * as an option of the line break before the row
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
    """Escape a text, and permit line breaks after commas and colons, because a cell can contain JSON without spaces."""
    return re.sub(r"([,:])(?=[^\s~])", r"\1\\allowbreak{}", _tex(text))
