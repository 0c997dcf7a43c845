from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import pytest

from lavt.errors import UserError
from lavt.safety.gate import RejectionReason, SafetyGate
from lavt.safety.limits import LIMITS
from lavt.safety.safety_page import GENERATED_BLOCKS, draw_page, value_with_unit
from lavt.safety.state_machine import TRANSITIONS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/safety.md").read_text()
TEST_REFERENCE = re.compile(r"`(?P<file>tests/[\w/]+\.py)(?:::(?P<name>\w+))?`")


def function_names(path: Path) -> set[str]:
    return {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}


def test_the_page_is_up_to_date() -> None:
    """docs/safety.md is what `python docs/draw_safety.py` generates, and has all generated blocks."""
    assert draw_page(PAGE) == PAGE, "docs/safety.md is outdated: run `python docs/draw_safety.py`"
    assert set(re.findall(r"<!-- drawn: ([a-z ]+) -->", PAGE)) == set(GENERATED_BLOCKS)


def test_a_changed_table_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """An additional transition changes the page."""
    monkeypatch.setitem(TRANSITIONS, ("driving", "emergency stop cleared"), "arming")
    changed = draw_page(PAGE)
    assert "    driving --> arming: emergency stop cleared\n" in changed
    assert "| emergency stop cleared | driving | arming |" in changed


def test_all_transitions_limits_and_rejections_are_drawn() -> None:
    """The page shows each transition, each limit with its reason, and the rejection reasons in checking order."""
    arrows = re.findall(r"(\w+) --> \w+: (.+)", GENERATED_BLOCKS["states"]())
    assert {(before, trigger) for before, triggers in arrows for trigger in triggers.split(", ")} == set(TRANSITIONS)
    rows = GENERATED_BLOCKS["limits of the vehicle"]().splitlines()[2:]
    assert len(rows) == len(LIMITS.__slots__)
    assert all(len(row.split(" | ")[2]) > 10 for row in rows)
    rejections = [line.partition(". ")[2] for line in GENERATED_BLOCKS["rejections"]().splitlines()]
    checked = re.findall(r"return RejectionReason\.(\w+)", inspect.getsource(SafetyGate.rejection_reason))
    assert rejections == [RejectionReason[name].value for name in checked] == list(RejectionReason)


@pytest.mark.parametrize(
    ("name", "value", "shown"),
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
def test_a_limit_is_shown_with_its_unit(name: str, value: float, shown: str) -> None:
    """A limit is shown with the unit that its name ends with."""
    assert value_with_unit(name, value) == shown


def test_an_unknown_block_is_rejected() -> None:
    """An unknown block is an error, whose message names the known blocks."""
    with pytest.raises(UserError, match="'cats': choose one of states, transitions"):
        draw_page("<!-- drawn: cats -->\n<!-- drawn until here -->")


def test_every_test_that_the_page_names_exists() -> None:
    """Each test and test file that the page names exists."""
    named = [(found["file"], found["name"]) for found in TEST_REFERENCE.finditer(PAGE)]
    assert len(named) > 40
    assert len(named) == PAGE.count("`tests/")
    existing = {file: function_names(ROOT / file) for file, _ in named if (ROOT / file).exists()}
    missing = [f"{file}::{name}" for file, name in named if name and name not in existing.get(file, set())]
    missing += [file for file, name in named if not name and file not in existing]
    assert missing == []


def test_every_hazard_has_a_mitigation() -> None:
    """Each hazard has a mitigation with a test, or the page says that nothing mitigates it."""
    table = PAGE.partition("## Hazards")[2].partition("\n## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("| ")]
    for hazard, mitigation, tests in rows[1:]:
        assert mitigation, hazard
        assert tests or mitigation.startswith("Nothing"), f"the mitigation of this hazard has no test: {hazard}"
