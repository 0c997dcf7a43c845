from __future__ import annotations

from pathlib import Path
from typing import Any

from lavt.experiment.report.controller_section import controller_parts
from lavt.experiment.report.figures.figure_style import condition_colours
from lavt.experiment.report.sections import ReportContext
from lavt.experiment.statistics.controllers import compare_controllers


def run(kind: str, p95_m: float, **axes: Any) -> dict[str, Any]:
    return {
        "time": "virtual",
        "condition": "H2",
        "route": "a",
        "repetition": 0,
        "seed": 7,
        "valid": True,
        "completed_in_own_lane": True,
        "p95_m": p95_m,
        "lateral_jerk_rms_mps3": 0.25,
        "steering_rate_rms_radps": 0.015,
        "distance_m": 100.0,
        "duration_s": 20.0,
        "axes": {"controller.kind": kind, **axes},
    }


def parts_of(runs: list[dict[str, Any]], directory: Path) -> str:
    summary = {"runs": runs, "controllers": compare_controllers(runs)}
    return " ".join(controller_parts(ReportContext(summary, directory, condition_colours(["H2"]))))


def test_comfort_is_shown_beside_tracking(tmp_path: Path) -> None:
    """Each controller has a row with its error, jerk and steering rate, and each place one with its tests."""
    rates = (10.0, 30.0)
    runs = [run(kind, p95_m, **{"camera.rate_hz": rate}) for rate in rates for kind, p95_m in KINDS.items()]
    page = parts_of(runs, tmp_path)
    table = (tmp_path / "tables" / "controllers.csv").read_text().splitlines()
    assert table[0].startswith("condition,camera rate hz,controller,runs,completed in own lane")
    assert "p95 m,lateral jerk m/s³ rms,steering rate rad/s rms".replace(" rms", ", rms") in table[0].replace('"', "")
    assert table[1].startswith("H2,10.0,predictive,1,1,")
    assert table[1].endswith("0.05,0.25,0.015,5.0")
    tests = (tmp_path / "tables" / "controller_tests.csv").read_text().splitlines()
    assert [line.split(",")[:4] for line in tests[1:]] == [["H2", str(rate), "smith", "1"] for rate in rates]
    assert "Wilcoxon" in page


KINDS = {"predictive": 0.05, "smith": 0.1, "lane_keeper": 0.2}


def test_other_controllers_are_shown_without_a_test(tmp_path: Path) -> None:
    """Without the controller that is tested, there is no table of tests; without a comparison, no section."""
    page = parts_of([run("smith", 0.1), run("lane_keeper", 0.2)], tmp_path)
    assert "lane_keeper" in page
    assert "Wilcoxon" not in page
    assert parts_of([run("smith", 0.1)], tmp_path) == ""
