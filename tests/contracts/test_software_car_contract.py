"""Test that the software car and the by-wire adapter share no code that knows a message layout."""

from __future__ import annotations

import ast
from importlib.util import find_spec
from pathlib import Path

import lavt
import lavt.vehicle.dbw
import lavt.vehicle.software_car

SOURCE = Path(lavt.__file__).parent.parent
SHARED_MODULES = {
    "lavt.vehicle.can_frame",  # frames and bus ports
    "lavt.vehicle.vehicle",
    "lavt.domain",
    "lavt.errors",
    "lavt.clock",
    "lavt.vehicle.ground_truth_wire",  # not sent over the bus
}
"""Modules that both the software car and the adapter can use. No such module contains a message layout."""


def python_files(package: str) -> set[Path]:
    spec = find_spec(package)
    assert spec is not None
    assert spec.submodule_search_locations is not None
    return {path for place in spec.submodule_search_locations for path in Path(place).rglob("*.py")}


def imported_modules(path: Path) -> set[str]:
    """Return LAVT's modules that a file imports directly, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, path
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("lavt.") and module_file(name) is not None}


def module_file(module: str) -> Path | None:
    path = SOURCE.joinpath(*module.split("."))
    return next(
        (candidate for candidate in (path.with_suffix(".py"), path / "__init__.py") if candidate.exists()), None
    )


def dependencies(package: str) -> set[str]:
    """Return LAVT's modules outside a package that it uses, directly or indirectly."""
    names: set[str] = set()
    unread_files = list(python_files(package))
    while unread_files:
        new_names = imported_modules(unread_files.pop()) - names
        names |= new_names
        unread_files += [path for name in new_names if (path := module_file(name)) is not None]
    return {name for name in names if not name.startswith(package)} - {"lavt.vehicle"}


def test_car_and_adapter_share_only_frames() -> None:
    """Modules that the software car and the adapter both use, directly or indirectly, contain no message layouts."""
    car, adapter = dependencies("lavt.vehicle.software_car"), dependencies("lavt.vehicle.dbw")
    assert "lavt.vehicle.can_frame" in car & adapter
    assert car & adapter <= SHARED_MODULES


def test_car_and_adapter_do_not_use_each_other() -> None:
    """Neither the software car nor the adapter imports the other, directly or indirectly."""
    assert not [name for name in dependencies("lavt.vehicle.software_car") if name.startswith("lavt.vehicle.dbw")]
    assert not [name for name in dependencies("lavt.vehicle.dbw") if name.startswith("lavt.vehicle.software_car")]


def test_the_car_reads_no_profile() -> None:
    """No file of the software car names the adapter's profiles or their DBC files."""
    for path in python_files("lavt.vehicle.software_car"):
        text = path.read_text(encoding="utf-8")
        assert ".dbc" not in text, path
        assert "profiles" not in text, path
