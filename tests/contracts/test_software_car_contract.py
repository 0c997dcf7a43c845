"""The software car and what drives it know of each other by the bus alone."""

from __future__ import annotations

import ast
from importlib.util import find_spec
from pathlib import Path

import lavt
import lavt.vehicle.dbw
import lavt.vehicle.software_car

SOURCE = Path(lavt.__file__).parent.parent
SHARED = {
    "lavt.vehicle.can_frame",  # frames, and what they come and go by
    "lavt.vehicle.vehicle", "lavt.domain", "lavt.errors", "lavt.value", "lavt.clock",  # the words of the design
    "lavt.vehicle.ground_truth_wire",  # which does not go over the bus
}  # fmt: skip
"""All that both sides may use: nothing of it knows what the bits of a frame mean."""


def files_of(package: str) -> set[Path]:
    spec = find_spec(package)
    assert spec is not None
    assert spec.submodule_search_locations is not None
    return {path for place in spec.submodule_search_locations for path in Path(place).rglob("*.py")}


def imported(path: Path) -> set[str]:
    """Name the modules of LAVT that a file imports itself, wherever in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, path
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("lavt.") and file_of(name) is not None}


def file_of(module: str) -> Path | None:
    path = SOURCE.joinpath(*module.split("."))
    return next((each for each in (path.with_suffix(".py"), path / "__init__.py") if each.exists()), None)


def used(package: str) -> set[str]:
    """Name every module of LAVT outside a package that it uses, directly or through others."""
    names: set[str] = set()
    waiting = list(files_of(package))
    while waiting:
        new = imported(waiting.pop()) - names
        names |= new
        waiting += [path for name in new if (path := file_of(name)) is not None]
    return {name for name in names if not name.startswith(package)} - {"lavt.vehicle"}


def test_they_share_frames_alone() -> None:
    """What both the software car and the adapter use, through however many modules, are words, and no bits."""
    car, adapter = used("lavt.vehicle.software_car"), used("lavt.vehicle.dbw")
    assert "lavt.vehicle.can_frame" in car & adapter
    assert car & adapter <= SHARED


def test_neither_uses_the_other() -> None:
    """Neither imports anything of the other, through however many modules."""
    assert not [name for name in used("lavt.vehicle.software_car") if name.startswith("lavt.vehicle.dbw")]
    assert not [name for name in used("lavt.vehicle.dbw") if name.startswith("lavt.vehicle.software_car")]


def test_the_car_reads_no_file_of_the_adapter() -> None:
    """No file of the software car names the adapter's profiles or their DBC files."""
    for path in files_of("lavt.vehicle.software_car"):
        text = path.read_text(encoding="utf-8")
        assert ".dbc" not in text, path
        assert "profiles" not in text, path
