"""Hooks of MkDocs (`mkdocs.yml`): the pages in the repository's root become pages of the site, too.

The links in all pages work on GitHub. Those between pages are rewritten for the site; those to other files of the
repository become plain text, because the site does not have these files.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
ROOT_PAGES = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""The pages in the repository's root, and their names in the site."""
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#:]+)(#[^)\s]*)?\)")
"""A link or picture with a relative path: its mark, text, path and anchor."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the repository's root."""
    for name, page in ROOT_PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the page with links that are valid in the site."""
    del config, files
    in_site = page.file.src_uri
    in_repository = {name: path for path, name in ROOT_PAGES.items()}.get(in_site, f"docs/{in_site}")
    return LINK.sub(lambda match: _relinked(match, in_repository, in_site), markdown)


def _relinked(match: re.Match[str], in_repository: str, in_site: str) -> str:
    """Return a link of a page for the site."""
    mark, text, path, anchor = match.groups(default="")
    target = posixpath.normpath(posixpath.join(posixpath.dirname(in_repository), path))
    if target not in ROOT_PAGES and not target.startswith("docs/"):
        return text
    target = ROOT_PAGES.get(target) or target.removeprefix("docs/")
    return f"{mark}[{text}]({posixpath.relpath(target, posixpath.dirname(in_site) or '.')}{anchor})"
