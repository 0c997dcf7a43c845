"""The HTML of the report's page and of its parts, rendered from `templates/`.

The page is one file: figures and video are inside it, and it loads nothing. Only links lead to other files of
the report. The templates escape every text argument of these functions.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

Section = tuple[str, Sequence[Markup]]
"""The heading of a section, and its parts."""

PHONE_CHARACTERS = 54
"""The characters that fit into a row of a table on a screen of 390 px, with one for the space between two columns."""
MAX_TEXT_CHARACTERS = 11
"""On a narrow screen, longer texts in a table are broken into lines."""

_TEMPLATES = Environment(
    loader=PackageLoader("lavt.experiment.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_PARTS: Any = _TEMPLATES.get_template("parts.html.j2").module


class Chapter(NamedTuple):
    """A part of the page that folds, with its sections."""

    heading: str
    sections: Sequence[Section]
    is_open: bool = False


_MEDIA_TYPES = {".svg": "image/svg+xml", ".png": "image/png", ".jpg": "image/jpeg", ".mp4": "video/mp4"}


def page(title: str, first: Sequence[Markup], chapters: Iterable[Chapter]) -> str:
    """Return the page: the parts of the first screen, then the chapters, without sections that have no parts."""
    shown = []
    for chapter in chapters:
        sections = [
            {"heading": name, "anchor": anchor(name), "parts": shown_parts}
            for name, parts in chapter.sections
            if (shown_parts := [part for part in parts if part])
        ]
        if sections:
            about = {"heading": chapter.heading, "anchor": chapter_anchor(chapter.heading)}
            shown.append({**about, "is_open": chapter.is_open, "sections": sections})
    return _TEMPLATES.get_template("page.html.j2").render(title=title, first=first, chapters=shown)


def anchor(section: str) -> str:
    """Return the anchor of the section with this heading."""
    return slug(section).lower()


def chapter_anchor(chapter: str) -> str:
    """Return the anchor of the chapter with this heading, which may be that of a section, too."""
    return f"chapter_{anchor(chapter)}"


def embedded(path: Path) -> str:
    """Return a file as an address that contains it."""
    return f"data:{_MEDIA_TYPES[path.suffix]};base64,{b64encode(path.read_bytes()).decode()}"


def _part(macro: str, *values: object) -> Markup:
    part: Markup = getattr(_PARTS, macro)(*values)
    return part


def slug(text: str) -> str:
    """Return `text` reduced to characters for a file name or an anchor."""
    return re.sub("[^A-Za-z0-9]+", "_", text).strip("_")


def heading(text: str) -> Markup:
    """Return a heading inside a section."""
    return _part("heading", text)


def paragraph(text: str, *, is_note: bool = False, link: tuple[str, str] | None = None) -> Markup:
    """Return a paragraph; a note is printed smaller. `link` has the text and the anchor of a link after the text."""
    return _part("paragraph", text, is_note, link)


def bullets(texts: Sequence[str]) -> Markup:
    """Return a list with one item for each text."""
    return _part("bullets", texts)


def terms(pairs: Sequence[tuple[str, str]]) -> Markup:
    """Return a legend: terms with their meanings."""
    return _part("terms", pairs)


def columns(parts: Sequence[Markup]) -> Markup:
    """Return figures next to each other, and a list below them; on a narrow screen all parts are below each other."""
    return _part("columns", parts)


def figure(shown: Path, files: Sequence[str], alternative: str, caption: str) -> Markup:
    """Return a figure with its caption and links to its files.

    The page contains the file `shown`. `files` are all formats.
    """
    return _part("figure", shown.stem, embedded(shown), files, alternative, caption)


def video(shown: Path, poster: Path, alternative: str, caption: str, key: Sequence[tuple[str, str]]) -> Markup:
    """Return a video that plays again and again without sound, with its caption and a link to its file.

    `poster` is the picture before the video plays and on paper. `key` has the colours with their meanings.
    """
    return _part("video", shown.name, embedded(shown), embedded(poster), alternative, caption, key)


def table(columns: Sequence[Any], rows: Sequence[Sequence[str]]) -> Markup:
    """Return a table; if it is wider than a phone, a narrow screen shows each row as a list of titles and cells.

    Each column has `title`, `is_text`, `is_long` and `is_extra`. A switch above the table shows the extra columns.
    """
    return _part("table", columns, rows, _characters(columns, rows) > PHONE_CHARACTERS)


def _characters(columns: Sequence[Any], rows: Sequence[Sequence[str]]) -> int:
    """Return the width in characters of the columns that are not extra, if titles and texts are broken into lines.

    A title has at most about four lines.
    """
    shown = [
        (column, max(map(len, cells)), max(len(column.title) // 3, *map(len, column.title.split())))
        for column, cells in zip(columns, zip(*rows, strict=True), strict=True)
        if not column.is_extra
    ]
    widths = [max(min(cell, MAX_TEXT_CHARACTERS) if column.is_text else cell, title) for column, cell, title in shown]
    return sum(widths) + len(widths)


def linked_table(html: Markup, files: Sequence[str], *, is_short: bool) -> Markup:
    """Return a table with links to `files`; a short table is not split between printed pages."""
    return _part("linked_table", html, files, is_short)
