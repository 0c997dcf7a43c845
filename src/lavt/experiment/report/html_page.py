"""The report's page: plain HTML that a phone shows, a printer prints, and that asks nothing of a network."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from string import Template

Section = tuple[str, Sequence[str]]
"""Its heading and its parts, which are HTML."""

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 62rem; margin: 0 auto;
       padding: 1rem; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; margin: .5rem 0; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .5rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
p, li, figcaption { max-width: 46rem; }
nav { font-size: .88rem; line-height: 1.9; }
nav a { margin-right: .9rem; white-space: nowrap; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; }
figcaption, .note, .files { color: #555; font-size: .88rem; }
.files { margin: .2rem 0 1rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .8rem; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .4rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top; }
th { border-bottom: 2px solid #888; vertical-align: bottom; }
th.text, td.text, th.long { text-align: left; }
td.long { white-space: normal; text-align: left; min-width: 14rem; }
@media (max-width: 40rem) { body { padding: .6rem; } figure.wide { overflow-x: auto; }
                            figure.wide img { min-width: 36rem; } }
@page { size: A4; margin: 12mm; }
@media print { body { max-width: none; font-size: 10pt; padding: 0; } nav, .files { display: none; }
               h2, h3 { break-after: avoid; } figure, tr { break-inside: avoid; } thead { display: table-header-group; }
               .scroll { overflow: visible; } .short { break-inside: avoid; }
               table { font-size: 7pt; } th, td { padding: .12rem .25rem; } td.long { min-width: 0; } }
</style>
</head>
<body>
$body
</body>
</html>
""")


def page(title: str, sections: Sequence[Section]) -> str:
    """Make the whole page of the sections that have any part; titles and headings are text.

    The first section has no heading of its own, the page's title stands above it.
    """
    shown = [(name, parts) for name, parts in sections if parts]
    (_, first), *others = shown or [("", [])]
    links = "".join(f'<a href="#{_anchor(name)}">{escape(name)}</a>' for name, _ in others)
    body = [f"<h1>{escape(title)}</h1>", *first, f"<nav>{links}</nav>"]
    for name, parts in others:
        body += [f'<h2 id="{_anchor(name)}">{escape(name)}</h2>', *parts]
    return _PAGE.substitute(title=escape(title), body="\n".join(body))


def _anchor(name: str) -> str:
    return slug(name).lower()


def slug(text: str) -> str:
    """Make of a text what can be a file's name or an anchor."""
    return re.sub("[^A-Za-z0-9]+", "_", text).strip("_")


def heading(text: str) -> str:
    """Head a part of a section."""
    return f"<h3>{escape(text)}</h3>"


def paragraph(text: str, *, note: bool = False) -> str:
    """Say something; a note is smaller."""
    return f'<p class="note">{escape(text)}</p>' if note else f"<p>{escape(text)}</p>"


def bullets(texts: Sequence[str]) -> str:
    """List sentences."""
    return "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>"


def picture(shown: str, names: Sequence[str], alternative: str, caption: str) -> str:
    """Show the picture `shown` beside the page, with links to it in every format, `names`."""
    image = f'<img src="{escape(shown)}" alt="{escape(alternative)}" loading="lazy">'
    return f'<figure class="wide">{image}<figcaption>{escape(caption)}</figcaption>{_files(names)}</figure>'


def table(html: str, names: Sequence[str], *, is_short: bool) -> str:
    """Place a table with links to it in other formats; a short one is not cut by the end of a printed page."""
    return f'<div class="short">{html}{_files(names)}</div>' if is_short else f"{html}{_files(names)}"


def _files(names: Sequence[str]) -> str:
    links = ", ".join(f'<a href="{escape(name)}">{escape(name.rpartition(".")[2].upper())}</a>' for name in names)
    return f'<div class="files">{links}</div>'
