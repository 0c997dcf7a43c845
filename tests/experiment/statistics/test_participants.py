from __future__ import annotations

from typing import Any

from lavt.experiment.statistics.participants import compare_studies


def run(participant: str | None, condition: str, p95_m: float | None, **changes: Any) -> dict[str, Any]:
    return {
        "participant": participant,
        "condition": condition,
        "p95_m": p95_m,
        "route": "a_key",
        "repetition": 0,
        "valid": True,
        "driver": "two_point",
        "ending": "completed",
        **changes,
    }


def values(*runs: dict[str, Any]) -> dict[str, Any]:
    (comparison,) = compare_studies(runs)
    return dict(comparison["measures"]["p95_m"])


COMPLETE = (run("1", "L0", 0.25), run("1", "L5", 0.75))


def test_a_participant_has_one_value_for_each_condition() -> None:
    """The value of a participant is the mean over the drives that are valid under every condition."""
    measure = values(
        run("10", "L0", 1.0),
        run("10", "L5", 2.0),
        *COMPLETE,
        run("1", "L0", 0.75, route="b_key"),
        run("1", "L5", 1.25, route="b_key"),
        run("1", "L0", 9.0, repetition=1),
        run("1", "L0", 9.0, repetition=2),
        run("1", "L5", 9.0, repetition=2, valid=False),
    )
    assert measure["values"] == {"1": [0.5, 1.0], "10": [1.0, 2.0]}
    assert (measure["participants"], measure["left_out"]) == (2, [])


def test_incomplete_participants_are_left_out() -> None:
    """A participant without a valid drive under a condition does not enter, and is named."""
    measure = values(*COMPLETE, run("2", "L0", 0.5), run("3", "L0", 0.5), run("3", "L5", None))
    assert measure["values"] == {"1": [0.25, 0.75]}
    assert measure["left_out"] == ["2", "3"]


def test_drivers_and_studies_are_compared_separately() -> None:
    """Participants of different drivers or studies have equal numbers, so each study has a comparison of its own."""
    others = [{**entry, "driver": "human"} for entry in COMPLETE]
    second = [{**entry, "sweep": "second"} for entry in COMPLETE]
    comparisons = compare_studies([*COMPLETE, *others, *second])
    assert [(entry["sweep"], entry["driver"]) for entry in comparisons] == [
        (None, "two_point"),
        (None, "human"),
        ("second", "two_point"),
    ]
    assert all(entry["measures"]["p95_m"]["participants"] == 1 for entry in comparisons)


def test_runs_outside_a_study_are_not_compared() -> None:
    """Runs without a participant, and a study with one condition, have no comparison."""
    assert compare_studies([run(None, "L0", 0.5), run(None, "L5", 0.5), run("1", "L0", 0.5)]) == []


def test_events_are_counted_per_drive() -> None:
    """Equal numbers of events are ties, although the drives differ by some cm, so that their rates per km differ."""
    runs = [
        run(str(number), condition, 0.5, distance_m=distance_m, steering_reversals_per_km=3000 / distance_m)
        for number in range(1, 8)
        for condition, distance_m in (("L0", 120.0), ("L5", 119.9))
    ]
    (comparison,) = compare_studies(runs)
    measure = comparison["measures"]["steering_reversals"]
    assert measure["values"]["7"] == [3.0, 3.0]
    assert (measure["friedman"]["p"], measure["pairs"][0]["p"], measure["pairs"][0]["differing"]) == (1.0, 1.0, 0)


def test_the_workload_is_compared_if_somebody_was_asked() -> None:
    """The raw TLX is a measure if there are answers; without answers, as of a model, it is none."""
    asked = [
        {"participant": "1", "condition": name, "driver": "two_point", "ending": "completed", "raw_tlx": load}
        for name, load in (("L0", 20.0), ("L5", 60.0))
    ]
    (comparison,) = compare_studies(COMPLETE, asked)
    assert comparison["measures"]["raw_tlx"]["values"] == {"1": [20.0, 60.0]}
    (comparison,) = compare_studies(COMPLETE, [{**entry, "raw_tlx": None} for entry in asked])
    assert "raw_tlx" not in comparison["measures"]
