"""The report's page: plain HTML that a phone shows, a printer prints, and that asks nothing of a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from string import Template
from typing import Any

NOTHING = "–"
UNBROKEN = "\N{NO-BREAK SPACE}"

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 62rem; margin: 0 auto;
       padding: 1rem; }
h1 { font-size: 1.6rem; margin: .5rem 0; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .5rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
p, figcaption { max-width: 46rem; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; }
figcaption, .note { color: #555; font-size: .88rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .8rem; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .4rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top;
}
th { border-bottom: 2px solid #888; vertical-align: bottom; }
th:first-child, td:first-child, .text { text-align: left; }
td.long { white-space: normal; text-align: left; min-width: 14rem; }
.bad { color: #a00; }
@media print { body { max-width: none; font-size: 10pt; padding: 0; } figure, tr { break-inside: avoid; }
               .scroll { overflow: visible; } table { font-size: 7pt; } th, td { padding: .15rem .3rem; } }
</style>
</head>
<body>
$body
</body>
</html>
""")


def page(title: str, parts: Sequence[str]) -> str:
    """Make the whole page; `parts` are HTML, `title` is text."""
    return _PAGE.substitute(title=escape(title), body="\n".join([f"<h1>{escape(title)}</h1>", *parts]))


def heading(text: str, level: int = 2) -> str:
    """Head a section."""
    return f"<h{level}>{escape(text)}</h{level}>"


def paragraph(text: str, *, note: bool = False) -> str:
    """Say something; a note is smaller."""
    return f'<p class="note">{escape(text)}</p>' if note else f"<p>{escape(text)}</p>"


def picture(name: str, alternative: str, caption: str) -> str:
    """Show the PNG `name` beside the page."""
    image = f'<img src="{escape(name)}" alt="{escape(alternative)}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def table(headers: Sequence[str], rows: Sequence[Sequence[str]], *, text_columns: Sequence[int] = ()) -> str:
    """Make a table of texts that scrolls sideways on a narrow screen; `text_columns` are for sentences."""
    head = "".join(f"<th>{escape(header)}</th>" for header in headers)
    body = "\n".join(f"<tr>{_cells(row, text_columns)}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def _cells(row: Sequence[str], text_columns: Sequence[int]) -> str:
    return "".join(
        f'<td class="long">{escape(cell)}</td>' if index in text_columns else f"<td>{escape(cell)}</td>"
        for index, cell in enumerate(row)
    )


def number(value: float | None, digits: int = 1) -> str:
    """Write a number with `digits` after the point; a dash where there is none."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """Write a share as whole per cent."""
    return NOTHING if value is None else f"{value * 100:.0f} %"


def interval(bounds: Sequence[float] | None, *, unit: float = 1.0, digits: int = 0) -> str:
    """Write an interval as "low to high", not to be broken."""
    if bounds is None:
        return NOTHING
    return f"{bounds[0] * unit:.{digits}f} to {bounds[1] * unit:.{digits}f}".replace(" ", UNBROKEN)


def latency(summary: Mapping[str, Any]) -> str:
    """Write a latency: median, the bound of what the clocks can make of it (not of a loop), and p5 to p95."""
    if summary["p50"] is None:
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
