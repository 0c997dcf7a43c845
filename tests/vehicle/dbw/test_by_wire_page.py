"""docs/by_wire.md shows the states as the code has them."""

from __future__ import annotations

from pathlib import Path

from lavt.vehicle.dbw.states import SENT_IN_STATE, TABLE

PAGE = Path(__file__).parents[3] / "docs/by_wire.md"
SAID_TABLE = "\n".join(f"| {state} | {words} |" for state, words in SENT_IN_STATE.items())
TRANSITIONS = "\n".join(f"| {', '.join(row.sources)} | {row.description} | {row.target} |" for row in TABLE)


def test_said() -> None:
    """The page says what is sent in each state as the table in the code does."""
    assert f"|---|---|\n{SAID_TABLE}\n\n" in PAGE.read_text(), f"write this into docs/by_wire.md:\n{SAID_TABLE}"


def test_transitions() -> None:
    """The page has the transitions of the table in the code, in its order."""
    assert f"|---|---|---|\n{TRANSITIONS}\n\n" in PAGE.read_text(), f"write this into docs/by_wire.md:\n{TRANSITIONS}"
