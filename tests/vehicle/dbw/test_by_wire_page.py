"""docs/by_wire.md contains the state machine of the code."""

from __future__ import annotations

from pathlib import Path

from lavt.vehicle.dbw.states import SENT_IN_STATE, TABLE

PAGE = Path(__file__).parents[3] / "docs/by_wire.md"
SENT_TABLE = "\n".join(f"| {state} | {text} |" for state, text in SENT_IN_STATE.items())
TRANSITIONS = "\n".join(f"| {', '.join(row.sources)} | {row.description} | {row.target} |" for row in TABLE)


def test_sent() -> None:
    """The page lists the frames sent in each state like the table in the code."""
    assert f"|---|---|\n{SENT_TABLE}\n\n" in PAGE.read_text(), f"write this into docs/by_wire.md:\n{SENT_TABLE}"


def test_transitions() -> None:
    """The page lists the transitions in the order of the table in the code."""
    assert f"|---|---|---|\n{TRANSITIONS}\n\n" in PAGE.read_text(), f"write this into docs/by_wire.md:\n{TRANSITIONS}"
