"""The HTML of the report's page and of its parts, rendered from `templates/`.

The page loads nothing from a network. The templates escape every text argument of these functions.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

Section = tuple[str, Sequence[Markup]]
"""The heading of a section, and its parts."""

_TEMPLATES = Environment(
    loader=PackageLoader("lavt.experiment.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_PARTS: Any = _TEMPLATES.get_template("parts.html.j2").module


def page(title: str, sections: Iterable[Section]) -> str:
    """Return the page, without the sections that have no parts.

    The first section has no heading, because the page's title is directly above it.
    """
    shown = [
        {"heading": heading, "anchor": slug(heading).lower(), "parts": parts} for heading, parts in sections if parts
    ]
    first = shown[0]["parts"] if shown else []
    return _TEMPLATES.get_template("page.html.j2").render(title=title, first=first, others=shown[1:])


def _part(macro: str, *values: object) -> Markup:
    part: Markup = getattr(_PARTS, macro)(*values)
    return part


def slug(text: str) -> str:
    """Return `text` reduced to characters for a file name or an anchor."""
    return re.sub("[^A-Za-z0-9]+", "_", text).strip("_")


def heading(text: str) -> Markup:
    """Return a heading inside a section."""
    return _part("heading", text)


def paragraph(text: str, *, is_note: bool = False) -> Markup:
    """Return a paragraph; a note is printed smaller."""
    return _part("paragraph", text, is_note)


def bullets(texts: Sequence[str]) -> Markup:
    """Return a list with one item for each text."""
    return _part("bullets", texts)


def figure(shown: str, files: Sequence[str], alternative: str, caption: str) -> Markup:
    """Return a figure with its caption and links to its files.

    `shown` is the file that the page shows, `files` are all formats of the figure.
    """
    return _part("figure", shown, files, alternative, caption)


def video(shown: str, alternative: str, caption: str) -> Markup:
    """Return a video that plays again and again without sound, with its caption and a link to its file."""
    return _part("video", shown, alternative, caption)


def table(columns: Sequence[Any], rows: Sequence[Sequence[str]]) -> Markup:
    """Return a table that scrolls sideways on a narrow screen; each column has `title`, `is_text` and `is_long`."""
    return _part("table", columns, rows)


def linked_table(html: Markup, files: Sequence[str], *, is_short: bool) -> Markup:
    """Return a table with links to `files`; a short table is not split between printed pages."""
    return _part("linked_table", html, files, is_short)
