from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from lavt.errors import UserError
from lavt.safety import gate
from lavt.safety.limits import LIMITS
from lavt.safety.safety_page import DRAWINGS, drawn, value_with_unit

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/safety.md").read_text()
TEST = re.compile(r"`(?P<file>tests/[\w/]+\.py)(?:::(?P<name>\w+))?`")


def functions(path: Path) -> set[str]:
    return {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}


def test_the_page_says_what_the_code_does() -> None:
    """docs/safety.md is as `python docs/draw_safety.py` draws it from the code, and all drawings are in it."""
    assert drawn(PAGE) == PAGE, "docs/safety.md is not what the code says: run `python docs/draw_safety.py`"
    assert set(re.findall(r"<!-- drawn: ([a-z ]+) -->", PAGE)) == set(DRAWINGS)


def test_a_changed_table_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A transition more, or another reason, makes the page differ."""
    monkeypatch.setitem(gate.TRANSITIONS, ("driving", "cleared"), "arming")
    changed = drawn(PAGE)
    assert "    driving --> arming: cleared\n" in changed
    assert "| cleared | driving | arming | the emergency stop was cleared |\n" in changed


def test_every_transition_limit_and_rejection_is_drawn() -> None:
    """Each row of the table is an arrow, each limit has its reason, and each reason that the gate gives is listed."""
    arrows = re.findall(r"(\w+) --> \w+: (.+)", DRAWINGS["states"]())
    assert {(before, trigger) for before, triggers in arrows for trigger in triggers.split(", ")} == set(
        gate.TRANSITIONS
    )
    rows = DRAWINGS["limits of the vehicle"]().splitlines()[2:]
    assert len(rows) == len(LIMITS.__slots__)
    assert all(len(row.split(" | ")[2]) > 10 for row in rows)
    rejections = DRAWINGS["rejections"]().splitlines()
    assert rejections[0] == "1. not the epoch in force"
    assert {gate.NOT_ARMED, gate.NOT_STATIONARY} <= {line.partition(". ")[2] for line in rejections}
    assert len(rejections) >= 10


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("stop_after_ns", 500_000_000, "500 ms"),
        ("no_lane_stop_ns", 2_500_000_000, "2.5 s"),
        ("speed_limit_mps", 40 / 3.6, "11.1 m/s (40 km/h)"),
        ("lateral_acceleration_mps2", 3.0, "3 m/s2"),
        ("steering_rate_radps", 0.8, "0.8 rad/s"),
        ("arming_steering_rad", 0.1, "0.1 rad"),
        ("stopping_distance_limit_m", 20.0, "20 m"),
        ("frozen_frames", 5, "5 frames"),
        ("arming_brake", 0.3, "0.3 of the pedal"),
    ],
)
def test_a_limit_is_told_with_its_unit(name: str, value: float, said: str) -> None:
    """The unit of a limit is the one that its name ends with."""
    assert value_with_unit(name, value) == said


def test_a_block_that_nobody_can_draw_is_rejected() -> None:
    """A block of another name is an error that names those there are."""
    with pytest.raises(UserError, match="'cats': choose one of states, transitions"):
        drawn("<!-- drawn: cats -->\n<!-- drawn until here -->")


def test_every_test_that_the_page_names_is_there() -> None:
    """Each hazard's test exists under the name that the page gives; one named by its file alone may be to come."""
    named = [(found["file"], found["name"]) for found in TEST.finditer(PAGE)]
    assert len(named) > 40
    assert len(named) == PAGE.count("`tests/")
    there = {file: functions(ROOT / file) for file, _ in named if (ROOT / file).exists()}
    missing = [f"{file}::{name}" for file, name in named if name and name not in there.get(file, set())]
    missing += [file for file, name in named if not name and file not in there]
    assert missing == []


def test_every_hazard_has_an_answer_and_most_have_a_test() -> None:
    """A row of the table of hazards says what answers it; without a test it says that nothing does."""
    table = PAGE.partition("## Hazards")[2].partition("\n## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("| ")]
    for hazard, answer, shown in rows[1:]:
        assert answer, hazard
        assert shown or answer.startswith("Nothing"), f"no test shows what answers: {hazard}"
