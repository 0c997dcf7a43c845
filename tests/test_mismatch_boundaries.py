from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path

from benchmarks.mismatch_boundaries import (
    DEPARTURES,
    SEARCHED,
    SEARCHED_KINDS,
    Place,
    Point,
    by_value,
    config_of,
    draw,
    read_points,
    search_points,
    table_row,
    values_of,
)

POINT = Point("wheelbase", "predictive", 2.8448, 1, 2630.6, None, "beyond")


def test_every_axis_has_its_exact_value() -> None:
    """The values of an axis are sorted, contain the exact one once, and can be configured."""
    assert values_of("frame_rate") == [10.0, 15.0, 30.0]
    assert len(values_of("speed")) == 5
    for name, kind in zip(SEARCHED, cycle(SEARCHED_KINDS), strict=False):
        config = config_of(Place(name, kind, values_of(name)[0], 2))
        assert (config.controller.kind, config.seed, config.fidelity) == (kind, 2, "geometry")
    assert config_of(Place("loss", "predictive", 0.1, 1)).video.repair_packets == 0


def test_a_search_continues_and_no_config_is_searched_twice(tmp_path: Path) -> None:
    """Places in the CSV are not searched again; the exact values of two axes are one search."""
    path = tmp_path / "out" / "points.csv"
    searched: list[Place] = []

    def search_all(places: Sequence[Place]) -> Iterable[Point]:
        searched.extend(places)
        return [Point(*place, None, None if place.value > 2.5 else 900.5, "") for place in places]

    exact, short, seeded = (Place("wheelbase", "predictive", *pair) for pair in ((2.8448, 1), (2.1336, 1), (2.8448, 2)))
    exact_lag, exact_noise = (Place(name, "predictive", value, 1) for name, value in (("delay", 0), (DEPARTURES[0], 0)))
    assert [point.place for point in search_points([exact], path, search_all)] == [exact]
    wanted = [exact, short, seeded, exact_lag, exact_noise]
    points = search_points(wanted, path, search_all)
    assert [point.place for point in points] == wanted
    assert searched == [exact, short, seeded, exact_lag, exact_noise]
    further = [Place(name, "predictive", value, 3) for name, value in (("delay", 0), ("speed_report", 1))]
    assert len(search_points(further, path, search_all)) == 2
    assert searched[5:] == further[:1]
    assert set(read_points(path)) >= {*points}


def test_points_outside_the_search_are_named() -> None:
    """A boundary beyond the search has no number, and is a triangle; the range of the seeds is an error bar."""
    found = [
        replace(POINT, value=3.556, seed=seed, theory_ms=1584.6, measured_ms=measured_ms, outside="")
        for seed, measured_ms in enumerate((1580.2, 1570.0, 1600.0), start=1)
    ]
    assert table_row([POINT, replace(POINT, seed=2)]).endswith("| 2.8448 | `predictive` | 2631 ms | beyond |")
    assert table_row(found).endswith("| 3.556 | `predictive` | 1585 ms | 1580 ms (1570 ms to 1600 ms) |")
    assert table_row([POINT, found[0], found[0]]).endswith("| 1580 ms (1580 ms to beyond) |")
    noisy = [replace(POINT, axis="position_noise", theory_ms=None, measured_ms=250.0, outside="")]
    assert table_row(noisy).endswith("| – | 250 ms |")
    assert [len(group) for group in by_value([POINT, *found])] == [1, 3]
    axes = draw([POINT, *found]).axes[0]
    markers = [line.get_marker() for line in axes.get_lines()]
    assert [marker for marker in markers if marker in ("^", "o")] == ["^", "o"]
