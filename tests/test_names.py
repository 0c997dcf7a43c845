"""Rules for names that no linter checks."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import lavt

SOURCES = Path(lavt.__file__).parent
MAX_MODULES = 20
COMMAND_FOLDERS = {SOURCES / "cli"}
"""Folders with one module per command."""


def test_class_names_are_unique() -> None:
    """No two classes of the package have the same name."""
    modules = defaultdict(list)
    for path in SOURCES.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                modules[node.name].append(str(path.relative_to(SOURCES)))
    assert {name: paths for name, paths in modules.items() if len(paths) > 1} == {}


def test_folders_are_small() -> None:
    """No folder has more than 20 modules, except the folder with one module per command."""
    folders = {path.parent for path in SOURCES.rglob("*.py")} - COMMAND_FOLDERS
    counts = {str(folder.relative_to(SOURCES)): len(list(folder.glob("[!_]*.py"))) for folder in folders}
    assert {folder: count for folder, count in counts.items() if count > MAX_MODULES} == {}
