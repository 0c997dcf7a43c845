from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lavt.experiment.statistics.by_road import group_by_road
from lavt.experiment.statistics.intervals import exact_interval, exact_rate_interval
from lavt.experiment.statistics.summary import summarize

SPEED = {"simulated_s": 100.0, "wall_s": 10.0, "jobs": 2}


def run(**changes: Any) -> dict[str, Any]:
    latency = {"p5": 60.0, "p50": 62.0, "p95": 86.0, "bound": 0.4, "n": 100}
    return {
        "run": "1",
        "time": "virtual",
        "inherent": "paper_wifi5",
        "controller": "lane",
        "preset": "designed",
        "driver": "controller",
        "condition": "L0",
        "route": "A",
        "ending": "completed",
        "valid": True,
        "p95_m": 1.0,
        "distance_m": 500.0,
        "collisions": 0,
        "lane_invasions": 2,
        "tau_v_ms": latency,
        "tau_c_ms": latency,
        "loop_ms": {key: value for key, value in latency.items() if key != "bound"},
        "injected_ms": {"video": 75.0, "control": 0.0},
        **changes,
    }


def test_summary_of_a_condition() -> None:
    """P95 is over completed runs, completion and events are over all valid runs."""
    runs = [run(), run(p95_m=3.0), run(ending="collision", p95_m=50.0, collisions=1), run(valid=False, p95_m=99.0)]
    condition = summarize(runs, SPEED)["conditions"]["L0"]
    assert (condition["runs"], condition["completed"]) == (3, 2)
    assert condition["completion_rate"] == pytest.approx(2 / 3)
    assert condition["collisions_per_run"] == pytest.approx(1 / 3)
    assert condition["collisions_per_run_interval"] == exact_interval(1, 3)
    assert condition["invasion_free_completion_rate"] == 0.0
    assert condition["p95_m"] == 2.0
    assert condition["injected_ms"] == {"video": 75.0, "control": 0.0}
    assert condition["tau_v_ms"] == {"p5": 60.0, "p50": 62.0, "p95": 86.0, "bound": 0.4, "n": 300}
    assert condition["loop_ms"] == {"p5": 60.0, "p50": 62.0, "p95": 86.0, "n": 300}


def test_a_condition_without_valid_runs_is_null() -> None:
    """A condition whose runs are all invalid is present, with 0 runs and null measures."""
    condition = summarize([run(valid=False)], SPEED)["conditions"]["L0"]
    assert condition["runs"] == 0
    assert condition["completion_rate"] is None
    assert condition["tau_v_ms"]["p50"] is None
    assert condition["injected_ms"]["video"] == 75.0


def test_real_and_virtual_runs_are_never_mixed() -> None:
    """Runs in real time are under `real`, runs in virtual time under `conditions`, and all under `runs`."""
    summary = summarize([run(), run(time="real", condition="L5")], SPEED)
    keys = {"schema", "speed", "runs", "failed", "conditions", "contrasts", "real", "groups", "controllers", "paper"}
    assert set(summary) == keys
    assert set(summary["conditions"]) == {"L0"}
    assert set(summary["real"]) == {"L5"}
    assert len(summary["runs"]) == 2


def test_conditions_are_of_the_base_config_and_groups_of_every_combination() -> None:
    """Further axes make groups; `conditions` includes only the runs of the base config."""
    runs = [run(preset=preset, axes={"speed": speed}) for preset in ("designed", "bold") for speed in (20, 30)]
    summary = summarize(runs, SPEED, base={"preset": "designed", "speed": 30})
    assert summary["conditions"]["L0"]["runs"] == 1
    assert [(group["preset"], group["speed"]) for group in summary["groups"]] == [
        ("designed", 20),
        ("designed", 30),
        ("bold", 20),
        ("bold", 30),
    ]
    assert all(group["conditions"]["L0"]["runs"] == 1 for group in summary["groups"])


def campaign(*, condition: str = "L0", bad_route: str | None = None, **changes: Any) -> list[dict[str, Any]]:
    """Return 30 runs, five on each of six routes; those on `bad_route` ended early."""
    return [
        run(condition=condition, route=route, repetition=repetition, seed=f"{route}{repetition}", **changes)
        | ({"ending": "safe_stop", "distance_m": 100.0 + repetition} if route == bad_route else {})
        for route in ("a", "a_key", "b", "b_key", "c", "c_key")
        for repetition in range(5)
    ]


def test_completion_by_route() -> None:
    """If one of six routes is never completed, its interval is 0 to 52 %; the pooled interval is that of 25 of 30."""
    condition = summarize(campaign(bad_route="b"), SPEED)["conditions"]["L0"]
    assert condition["endings"] == {"completed": 25, "safe_stop": 5}
    assert condition["completion_interval"] == exact_interval(25, 30)
    assert {name: route["completed"] for name, route in condition["routes"].items()} == {
        "a": 5,
        "a_key": 5,
        "b": 0,
        "b_key": 5,
        "c": 5,
        "c_key": 5,
    }
    assert condition["routes"]["b"]["completion_interval"] == pytest.approx([0.0, 1 - 0.025**0.2])
    assert condition["routes"]["b"]["p95_m"] is None
    assert condition["survival"]["b"]["surviving"][-1] == 0.0


def test_p95_of_the_routes_has_equal_weights() -> None:
    """A route with three completed runs and one with a single one count equally; one without any is left out."""
    runs = [run(p95_m=1.0)] * 3 + [run(route="B", p95_m=5.0), run(route="C", ending="collision", p95_m=9.0)]
    condition = summarize(runs, SPEED)["conditions"]["L0"]
    assert (condition["p95_m"], condition["p95_route_balanced_m"], condition["p95_routes"]) == (2.0, 3.0, 2)


def test_results_by_road() -> None:
    """Each road counts once; with six roads there is an interval, with five none."""
    roads = [run(route=f"road{number}", p95_m=float(number)) for number in range(6)]
    runs = [*roads, *(run(route="road0", ending="collision", collisions=1, p95_m=9.0) for _ in range(3))]
    by_road = summarize(runs, SPEED)["conditions"]["L0"]["by_road"]
    assert by_road["completion_rate"]["mean"] == pytest.approx((0.25 + 5) / 6)
    assert by_road["collisions_per_run"]["mean"] == pytest.approx(0.75 / 6)
    assert (by_road["p95_m"]["mean"], by_road["p95_m"]["roads"]) == (2.5, 6)
    assert 0.0 <= by_road["p95_m"]["low"] < 1.0
    assert 4.0 < by_road["p95_m"]["high"] <= 5.0
    assert by_road["p95_all_runs_m"]["mean"] == pytest.approx((3 * 9 / 4 + 1 + 2 + 3 + 4 + 5) / 6)
    assert by_road["own_lane_completion_rate"] == {"roads": 0, "mean": None, "low": None, "high": None}
    few = summarize(runs[1:6], SPEED)["conditions"]["L0"]["by_road"]
    assert few["p95_m"] == {"roads": 5, "mean": 3.0, "low": None, "high": None}


def test_rates_by_road_have_an_exact_interval() -> None:
    """Six roads that are all completed give 54 to 100 %, as six of six; three such roads give no interval."""
    runs = [run(route=f"road{number}") for number in range(6)]
    by_road = summarize(runs, SPEED)["conditions"]["L0"]["by_road"]
    assert [by_road["completion_rate"][key] for key in ("low", "high")] == exact_interval(6, 6)
    assert [by_road["collisions_per_run"][key] for key in ("low", "high")] == exact_interval(0, 6)
    assert summarize(runs[:3], SPEED)["conditions"]["L0"]["by_road"]["completion_rate"]["low"] is None


def test_collisions_that_do_not_end_a_run_are_counts() -> None:
    """If a run goes on after a collision, the intervals are those of a count, and of the roads' means."""
    runs = [run(route=f"road{number}", collisions=number) for number in range(6)]
    condition = summarize(runs, SPEED)["conditions"]["L0"]
    assert condition["collisions_per_run_interval"] == exact_rate_interval(15, 6)
    assert condition["by_road"]["collisions_per_run"]["high"] > 1.0


@pytest.mark.parametrize("suffix", ["", ".yaml", ".yml"])
def test_a_route_and_its_key_route_are_one_road(suffix: str) -> None:
    """Two routes whose names or paths differ only by `_key` are one road."""
    runs = [run(route=f"roads/my{suffix}"), run(route=f"roads/my_key{suffix}", ending="collision"), run(route="b")]
    assert [len(on_road) for on_road in group_by_road(runs).values()] == [1, 2]


def test_rates_by_distance_are_of_all_kilometres() -> None:
    """One collision in 0.1 km and none in 0.9 km are 1 per kilometre, not the mean of 10 and 0."""
    runs = [run(distance_m=100.0, collisions=1, ending="collision"), run(distance_m=900.0)]
    assert summarize(runs, SPEED)["conditions"]["L0"]["collisions_per_km"] == pytest.approx(1.0)


def test_missing_values_are_left_out() -> None:
    """Means are over valid runs, and latencies are medians over runs; runs without a value are left out."""
    stages = [{"node": "camera", "stage": "encode", "p50": 2.0, "p95": 3.0, "n": 9}]
    ages = {"p5": 1.0, "p50": 2.0, "p95": 3.0, "n": 10}
    runs = [
        run(
            mae_m=1.0,
            oscillation_hz=0.4,
            stages_ms=stages,
            age_at_actuation_ms=ages,
            picture_age_ms={"mean": 90, "p95": 99},
        ),
        run(
            mae_m=2.0,
            oscillation_hz=None,
            stages_ms=[{**stages[0], "p50": 4.0}],
            age_at_actuation_ms={**ages, "p50": 4.0},
        ),
        run(mae_m=1.5, age_at_actuation_ms={**ages, "p50": 9.0}),
        run(mae_m=9.0, oscillation_hz=9.0, valid=False),
    ]
    condition = summarize(runs, SPEED)["conditions"]["L0"]
    assert (condition["mae_m"], condition["oscillation_hz"], condition["rms_m"]) == (1.5, 0.4, None)
    assert condition["stages_ms"] == [{"node": "camera", "stage": "encode", "p50": 3.0}]
    assert condition["age_at_actuation_ms"] == {**ages, "p50": 4.0, "n": 30}
    assert condition["picture_age_ms"] == {"mean": 90.0, "p95": 99.0}


def test_the_three_summaries_of_tracking_error() -> None:
    """P95 is given for completed runs, for the common distance, and for all runs with incomplete runs ranked last."""
    runs = [
        *campaign(p95_m=2.0, p95_by_10m=[0.1, 0.2, 0.3]),
        *campaign(condition="L1", bad_route="b", p95_m=4.0, p95_by_10m=[0.5, 0.6]),
    ]
    conditions = summarize(runs, SPEED)["conditions"]
    assert (conditions["L0"]["p95_m"], conditions["L1"]["p95_m"]) == (2.0, 4.0)
    assert conditions["L0"]["p95_common_m"] == pytest.approx(0.2)
    assert conditions["L0"]["p95_common_interval"] == pytest.approx([0.2, 0.2])
    assert conditions["L1"]["p95_common_m"] == pytest.approx(0.6)
    assert conditions["L1"]["p95_worst_rank_m"] == {"p25": 4.0, "p50": 4.0, "p75": 4.0}


def test_each_group_has_contrasts() -> None:
    """Runs are paired only within a group; the summary's contrasts are those of the base config's group."""
    runs = [
        entry
        for speed, bad_route in ((20, None), (30, "b"))
        for entry in (
            *campaign(axes={"speed": speed}),
            *campaign(condition="L1", bad_route=bad_route, axes={"speed": speed}),
        )
    ]
    summary = summarize(runs, SPEED, base={"speed": 30})
    pairs = [(group["contrasts"][0]["pairs"], group["contrasts"][0]["p"]) for group in summary["groups"]]
    assert pairs == [(30, 1.0), (30, pytest.approx(0.0625))]
    assert summary["contrasts"] == summary["groups"][1]["contrasts"]


def test_results_of_an_older_version_are_summarised() -> None:
    """Keys that an older result lacks are null or empty in the summary; all other keys are summarized."""
    condition = summarize([run()], SPEED)["conditions"]["L0"]
    assert condition["completion_rate"] == 1.0
    assert (condition["p95_common_m"], condition["mae_m"], condition["stages_ms"]) == (None, None, [])
    assert condition["age_at_actuation_ms"] == {"p5": None, "p50": None, "p95": None, "n": 0}
    assert condition["survival"]["A"]["distance_m"] == [0.0, 500.0]


def test_a_summary_without_runs() -> None:
    """Without runs, the summary has no conditions and no contrasts, but has the paper's results."""
    summary = summarize([], None)
    assert (summary["conditions"], summary["contrasts"], summary["groups"]) == ({}, [], [])
    assert list(summary["paper"]["conditions"]) == ["L0", "L1", "L2", "L3", "L4", "L5"]


def test_the_bound_of_a_condition_is_the_largest() -> None:
    """The bound of a condition's latency is the largest bound of its runs, and null if one run has no bound."""
    latency = run()["tau_v_ms"]
    runs = [run(), run(tau_v_ms={**latency, "bound": 0.8}), run(tau_c_ms={**latency, "bound": None})]
    condition = summarize(runs, SPEED)["conditions"]["L0"]
    assert (condition["tau_v_ms"]["bound"], condition["tau_c_ms"]["bound"]) == (0.8, None)


def test_the_latencies_of_the_page_are_summarized() -> None:
    """Runs without a person do not count; the others give medians of percentiles, the largest maximum and bound."""
    page = {"p5": 20.0, "p50": 30.0, "p95": 40.0, "bound": 0.3, "n": 10, "max": 90.0}
    nobody = {"p5": None, "p50": None, "p95": None, "bound": None, "n": 0, "max": None}
    other = {**page, "p50": 50.0, "bound": 0.5, "max": 60.0}
    runs = [run(page_shown_ms=page), run(page_shown_ms=nobody), run(page_shown_ms=other), run()]
    condition = summarize(runs, SPEED)["conditions"]["L0"]
    assert condition["page_shown_ms"] == {**page, "p50": 40.0, "bound": 0.5, "n": 20}
    assert condition["page_decoded_ms"] == nobody


def test_every_value_is_defined_in_the_documentation() -> None:
    """`docs/metrics.md` has each key of the summary, of a condition and of a contrast."""
    page = (Path(__file__).parents[3] / "docs" / "metrics.md").read_text()
    summary = summarize([run(), run(condition="L1")], SPEED)
    keys = {*summary, *summary["conditions"]["L0"], *summary["contrasts"][0], *summary["groups"][0]} - {"a", "b"}
    assert {key for key in keys if f"`{key}`" not in page and f"    {key} " not in page} == set()
