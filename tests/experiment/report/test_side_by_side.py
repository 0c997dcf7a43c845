"""The results of several sweeps side by side."""

from __future__ import annotations

from typing import Any

from lavt.experiment.report.side_by_side import side_by_side


def run(route: str, condition: str, ending: str, p95_m: float | None) -> dict[str, Any]:
    return {"route": route, "condition": condition, "ending": ending, "p95_m": p95_m}


def test_each_route_and_condition_has_a_line() -> None:
    """A line has completed runs and the mean error of each sweep, and the difference; a file's route has its stem."""
    ours = [run("roads/my.yaml", "L0", "completed", 0.1), run("roads/my.yaml", "L0", "off_road", 0.3)]
    ours.append(run("a_key", "L5", "completed", 0.5))
    theirs = [run("roads/my.yaml", "L0", "completed", 0.15), run("a_key", "L5", "collision", None)]
    assert side_by_side({"simulator": ours, "carla": theirs}) == [
        "route  condition  simulator: completed  P95 (m)  carla: completed  P95 (m)  difference (m)",
        "a_key  L5         1 of 1                0.500    0 of 1            -        -",
        "my     L0         1 of 2                0.200    1 of 1            0.150    -0.050",
    ]


def test_the_largest_difference_is_shown() -> None:
    """Of more than two sweeps, the difference that is farthest from the first sweep is shown, with its sign."""
    sweeps = {name: [run("a", "L0", "completed", p95_m)] for name, p95_m in (("x", 0.2), ("y", 0.25), ("z", 0.1))}
    assert side_by_side(sweeps)[1].endswith("-0.100")


def test_a_condition_that_one_sweep_lacks_is_shown() -> None:
    """A condition of one sweep only has no runs and no difference in the other one."""
    lines = side_by_side({"x": [run("a", "L0", "completed", 0.2)], "y": [run("a", "L1", "completed", 0.2)]})
    assert [line.split()[2:] for line in lines[1:]] == [
        ["1", "of", "1", "0.200", "0", "of", "0", "-", "-"],
        ["0", "of", "0", "-", "1", "of", "1", "0.200", "-"],
    ]
