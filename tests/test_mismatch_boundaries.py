from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks.mismatch_axes import AXES
from benchmarks.mismatch_boundaries import (
    SEARCHED,
    SEARCHED_KINDS,
    Point,
    config_of,
    draw,
    read_points,
    search_points,
    table_row,
    values_of,
)

POINT = Point("wheelbase", "predictive", 2.8448, 2630.6, None, "beyond")


def test_every_axis_has_its_exact_value() -> None:
    """The values of an axis are sorted, contain the exact one once, and can be configured for each controller."""
    assert values_of("frame_rate") == [10.0, 15.0, 30.0]
    assert len(values_of("speed")) == 4
    for name in SEARCHED:
        for kind in SEARCHED_KINDS:
            assert config_of(AXES[name], kind, values_of(name)[0]).controller.kind == kind


def test_a_search_continues(tmp_path: Path) -> None:
    """Points in the CSV are not searched again, and others are appended."""
    path, searched = tmp_path / "out" / "points.csv", []

    def search(axis: str, kind: str, value: float) -> Point:
        searched.append(value)
        return replace(POINT, axis=axis, kind=kind, value=value, measured_ms=None if value > 2.5 else 900.5)

    first = [("wheelbase", "predictive", 2.8448)]
    assert search_points(first, path, search=search) == [POINT]
    both = search_points([*first, ("wheelbase", "predictive", 2.1336)], path, search=search)
    assert searched == [2.8448, 2.1336]
    assert read_points(path) == both


def test_points_outside_the_search_are_named() -> None:
    """A boundary beyond the search has no number, and is drawn as a triangle."""
    found = replace(POINT, value=3.556, theory_ms=1584.6, measured_ms=1580.2, outside="")
    assert table_row(POINT).endswith("| 2.8448 | `predictive` | 2631 ms | beyond |")
    assert table_row(found).endswith("| 3.556 | `predictive` | 1585 ms | 1580 ms |")
    markers = [line.get_marker() for line in draw([POINT, found]).axes[0].get_lines()]
    assert markers == ["None", "^", "o", "None"]
