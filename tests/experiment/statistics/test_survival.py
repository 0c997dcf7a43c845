from __future__ import annotations

from typing import Any

import pytest

from lavt.experiment.statistics.intervals import exact_interval
from lavt.experiment.statistics.survival import survival


def run(distance_m: float | None, ending: str, length_m: float | None = 100.0) -> dict[str, Any]:
    return {"distance_m": distance_m, "ending": ending, "route_length_m": length_m}


def test_survival_by_hand() -> None:
    """Of five runs two end at 30 and 60 m in two ways: 1, 4/5, 3/5 still drive, with exact intervals."""
    curve = survival(
        [run(60.0, "safe_stop"), run(99.6, "completed"), run(30.0, "collision"), *[run(99.0, "completed")] * 2]
    )
    assert curve is not None
    assert curve["distance_m"] == [0.0, 30.0, 60.0, 100.0]
    assert curve["surviving"] == pytest.approx([1.0, 0.8, 0.6, 0.6])
    assert curve["incidence"] == {"collision": [0.0, 0.2, 0.2, 0.2], "safe_stop": [0.0, 0.0, 0.2, 0.2]}
    bands = [exact_interval(count, 5) for count in (5, 4, 3, 3)]
    assert list(zip(curve["low"], curve["high"], strict=True)) == [tuple(band or ()) for band in bands]


def test_survival_and_incidence_add_up_to_all_runs() -> None:
    """At every distance the runs that drive and those that ended, in whichever way, are all runs."""
    curve = survival([run(10.0, "collision"), run(10.0, "off_road"), run(20.0, "timeout"), run(100.0, "completed")])
    assert curve is not None
    for index, share in enumerate(curve["surviving"]):
        assert share + sum(each[index] for each in curve["incidence"].values()) == pytest.approx(1.0)


def test_all_completed_and_none_completed() -> None:
    """Where all were completed the curve stays 1 and nothing ended; where none was it falls to 0."""
    all_of_them = survival([run(100.0, "completed")] * 3)
    assert all_of_them is not None
    assert (all_of_them["distance_m"], all_of_them["surviving"]) == ([0.0, 100.0], [1.0, 1.0])
    assert all_of_them["incidence"] == {}
    assert all_of_them["low"] == pytest.approx([0.025 ** (1 / 3)] * 2)
    none_of_them = survival([run(40.0, "timeout")])
    assert none_of_them is not None
    assert (none_of_them["distance_m"], none_of_them["surviving"]) == ([0.0, 40.0, 100.0], [1.0, 0.0, 0.0])


def test_an_end_at_the_start_is_an_event() -> None:
    """A run that ended where it began is none of those that still drive at 0 m."""
    curve = survival([run(0.0, "collision"), run(100.0, "completed")])
    assert curve is not None
    assert (curve["distance_m"], curve["surviving"]) == ([0.0, 100.0], [0.5, 0.5])


def test_survival_of_what_is_not_known() -> None:
    """Runs without truth are left out; where no run knows the route's length, it is as far as any came."""
    assert survival([]) is None
    assert survival([run(None, "completed")]) is None
    curve = survival([run(None, "collision"), run(50.0, "collision", None), run(99.0, "completed", None)])
    assert curve is not None
    assert (curve["distance_m"], curve["surviving"]) == ([0.0, 50.0, 99.0], [1.0, 0.5, 0.5])
