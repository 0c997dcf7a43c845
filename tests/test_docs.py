"""README and docs: their links, commands and config keys exist, and the generated pages are up to date."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml
from docs.draw_reference import PAGES, TOPS, slug
from typer.main import get_command

import lavt
from lavt.cli.main import build_app
from lavt.config import Section

ROOT = Path(__file__).parents[1]
DOCS = [path for path in ROOT.glob("*.md") if path.name != "CHANGELOG.md"] + sorted((ROOT / "docs").rglob("*.md"))
each_page = pytest.mark.parametrize("page", DOCS, ids=lambda path: path.relative_to(ROOT).as_posix())
importing = pytest.mark.usefixtures("restored_environment")
"""For tests that import the modules of all commands: OpenCV sets an environment variable."""
LAVT = re.compile(r"(?:^ {4}|`|&& |^)(?:sudo )?(?:\S*/bin/)?lavt ((?!\.\.\.)[a-z][^`\n]*)", re.MULTILINE)
"""A command of `lavt`: in an indented line or between backticks."""


@importing
@pytest.mark.parametrize("name", PAGES)
def test_generated_pages(name: str) -> None:
    """A generated page is what `python docs/draw_reference.py` writes."""
    is_current = (ROOT / "docs" / name).read_text(encoding="utf-8") == PAGES[name]()
    assert is_current, f"docs/{name} is outdated: run `python docs/draw_reference.py`"


@cache
def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {slug(re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)) for heading in headings}


@each_page
def test_links(page: Path) -> None:
    """Each relative link of a page names an existing file and, if it has an anchor, a heading of that page."""
    broken = []
    for target, anchor in re.findall(r"\]\((?!https?:)([^)\s#]*)(?:#([^)\s]*))?\)", page.read_text(encoding="utf-8")):
        file = page.parent / target if target else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(f"{target}#{anchor}")
    assert broken == []


@each_page
def test_a_page_opens_with_its_purpose(page: Path) -> None:
    """A page begins with a heading and a paragraph that says what the page is for."""
    title, paragraph, *_ = page.read_text(encoding="utf-8").split("\n\n")
    assert title.startswith("# ")
    if page.relative_to(ROOT).parts[0] == "docs" and page.parent.name != "decisions":
        assert re.search(r"[Tt]his (page|tutorial)", paragraph), paragraph
    else:
        assert re.match(r"[A-Z*`]", paragraph), paragraph


@cache
def command_line() -> Any:
    return get_command(build_app())


def named_commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command of `lavt` in a text, up to a comment or another command."""
    for line in LAVT.findall(text):
        command = re.split(r" +#| && | ; |;|>| {3,}|\.\.\.|\)", line)[0]
        try:
            yield shlex.split(command)
        except ValueError:  # an apostrophe in prose
            yield command.split()


@importing
@each_page
def test_commands(page: Path) -> None:
    """Each command of `lavt` on a page exists, with the named options and the named keys of its config."""
    faults = []
    for words in named_commands(page.read_text(encoding="utf-8")):
        command, name = command_line(), "lavt"
        while words and words[0] in getattr(command, "commands", {}):
            name = f"{name} {words[0]}"
            command = command.commands[words.pop(0)]
        if hasattr(command, "commands") and words and not words[0].startswith("-"):
            faults.append(f"{name} {words[0]}")
        known = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        faults += [f"{name} {word}" for word in words if word.startswith("--") and word.partition("=")[0] not in known]
        changes = [word for option, word in pairwise(words) if option == "--set"]
        if name != "lavt router":
            faults += [f"{name} --set {change}" for change in changes if not is_key(change.partition("=")[0])]
    assert faults == []


def is_key(key: str) -> bool:
    """Return whether a config has this key; below a mapping, every key exists."""
    return any(has_key(kind, key.split(".")) for kind, _ in TOPS.values())


def has_key(kind: Any, parts: list[str]) -> bool:
    """Return whether the key with these parts exists in a section."""
    if not (isinstance(kind, type) and issubclass(kind, Section)):
        return bool(get_args(kind)) or kind is Any
    field = kind.model_fields.get(parts[0])
    return field is not None and (len(parts) == 1 or has_key(field.annotation, parts[1:]))


@each_page
def test_shipped_files(page: Path) -> None:
    """Each config, router config, example and benchmark that a page names exists."""
    text = page.read_text(encoding="utf-8")
    pattern = r"(?<![\w/.-])(?:configs|zenoh-configs|netem|examples|benchmarks|deploy)/[\w./-]*\w\.\w+"
    missing = {file for file in re.findall(pattern, text) if not (ROOT / file).exists()}
    assert missing == set()


def test_citation() -> None:
    """`CITATION.cff` has the present version and cites the paper by the title that the docs have."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == lavt.__version__
    assert citation["references"][0]["title"] in (ROOT / "docs/reproduce.md").read_text(encoding="utf-8")
