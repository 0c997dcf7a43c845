from __future__ import annotations

from typing import Any

import pytest

from lavt.experiment.statistics.intervals import exact_interval
from lavt.experiment.statistics.survival import survival


def run(distance_m: float | None, ending: str, length_m: float | None = 100.0) -> dict[str, Any]:
    return {"distance_m": distance_m, "ending": ending, "route_length_m": length_m}


def test_survival_of_five_runs() -> None:
    """If two of five runs end at 30 and 60 m, the surviving shares are 1, 4/5 and 3/5, with exact intervals."""
    curve = survival(
        [run(60.0, "safe_stop"), run(99.6, "completed"), run(30.0, "collision"), *[run(99.0, "completed")] * 2]
    )
    assert curve is not None
    assert curve["distance_m"] == [0.0, 30.0, 60.0, 100.0]
    assert curve["surviving"] == pytest.approx([1.0, 0.8, 0.6, 0.6])
    assert curve["incidence"] == {"collision": [0.0, 0.2, 0.2, 0.2], "safe_stop": [0.0, 0.0, 0.2, 0.2]}
    intervals = [exact_interval(count, 5) for count in (5, 4, 3, 3)]
    assert list(zip(curve["low"], curve["high"], strict=True)) == [tuple(interval or ()) for interval in intervals]


def test_survival_and_incidence_add_up_to_all_runs() -> None:
    """At every distance, the shares of driving and ended runs add up to 1."""
    curve = survival([run(10.0, "collision"), run(10.0, "off_road"), run(20.0, "timeout"), run(100.0, "completed")])
    assert curve is not None
    for index, share in enumerate(curve["surviving"]):
        assert share + sum(incidence[index] for incidence in curve["incidence"].values()) == pytest.approx(1.0)


def test_survival_of_completed_and_of_ended_runs() -> None:
    """If all runs were completed, survival remains 1; if none was, it falls to 0."""
    all_completed = survival([run(100.0, "completed")] * 3)
    assert all_completed is not None
    assert (all_completed["distance_m"], all_completed["surviving"]) == ([0.0, 100.0], [1.0, 1.0])
    assert all_completed["incidence"] == {}
    assert all_completed["low"] == pytest.approx([0.025 ** (1 / 3)] * 2)
    none_completed = survival([run(40.0, "timeout")])
    assert none_completed is not None
    assert (none_completed["distance_m"], none_completed["surviving"]) == ([0.0, 40.0, 100.0], [1.0, 0.0, 0.0])


def test_an_end_at_the_start_is_an_event() -> None:
    """A run that ended at its start does not survive at 0 m."""
    curve = survival([run(0.0, "collision"), run(100.0, "completed")])
    assert curve is not None
    assert (curve["distance_m"], curve["surviving"]) == ([0.0, 100.0], [0.5, 0.5])


def test_survival_with_missing_data() -> None:
    """Runs without truth are left out; without a known length, the route ends at the longest distance."""
    assert survival([]) is None
    assert survival([run(None, "completed")]) is None
    curve = survival([run(None, "collision"), run(50.0, "collision", None), run(99.0, "completed", None)])
    assert curve is not None
    assert (curve["distance_m"], curve["surviving"]) == ([0.0, 50.0, 99.0], [1.0, 0.5, 0.5])
