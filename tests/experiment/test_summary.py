from __future__ import annotations

from typing import Any

import pytest

from lavt.experiment.statistics import bootstrap_interval
from lavt.experiment.summary import summarize

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


def test_bootstrap_is_repeatable_and_about_right() -> None:
    """The same runs give the same interval, and that of 100 equal steps is 1.96 standard errors wide to a tenth."""
    values = [index / 99 for index in range(100)]
    interval = bootstrap_interval(values)
    assert interval == bootstrap_interval(values)
    assert interval is not None
    assert interval[0] == pytest.approx(0.5 - 1.96 * 0.0291, abs=0.006)
    assert interval[1] == pytest.approx(0.5 + 1.96 * 0.0291, abs=0.006)


def test_a_condition_is_counted() -> None:
    """Completion, events and p95 of a condition: p95 over completed runs, the rest over all valid ones."""
    runs = [run(), run(p95_m=3.0), run(ending="collision", p95_m=50.0, collisions=1), run(valid=False, p95_m=99.0)]
    condition = summarize(runs, SPEED)["conditions"]["L0"]
    assert (condition["runs"], condition["completed"]) == (3, 2)
    assert condition["completion_rate"] == pytest.approx(2 / 3)
    assert condition["collisions_per_run"] == pytest.approx(1 / 3)
    assert condition["p95_m"] == 2.0
    assert condition["injected_ms"] == {"video": 75.0, "control": 0.0}
    assert condition["tau_v_ms"] == {"p5": 60.0, "p50": 62.0, "p95": 86.0, "bound": 0.4, "n": 300}
    assert condition["loop_ms"] == {"p5": 60.0, "p50": 62.0, "p95": 86.0, "n": 300}


def test_a_condition_without_valid_runs_is_null() -> None:
    """A condition whose runs are all invalid is there, with no runs and nothing claimed."""
    condition = summarize([run(valid=False)], SPEED)["conditions"]["L0"]
    assert condition["runs"] == 0
    assert condition["completion_rate"] is None
    assert condition["tau_v_ms"]["p50"] is None
    assert condition["injected_ms"]["video"] == 75.0


def test_real_and_virtual_runs_are_never_mixed() -> None:
    """Runs in real time are under `real`, runs in virtual time under `conditions`, and all under `runs`."""
    summary = summarize([run(), run(time="real", condition="L5")], SPEED)
    assert set(summary) == {"schema", "speed", "runs", "conditions", "contrasts", "real", "groups", "paper"}
    assert set(summary["conditions"]) == {"L0"}
    assert set(summary["real"]) == {"L5"}
    assert len(summary["runs"]) == 2


def test_conditions_are_of_the_base_config_and_groups_of_every_combination() -> None:
    """Further axes make groups; `conditions` holds only the runs of the base config."""
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
