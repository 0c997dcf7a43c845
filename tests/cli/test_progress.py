from __future__ import annotations

import sys

import pytest
from tests.support.clocks import ManualClock

from lavt.cli.progress import left_words, progress
from lavt.domain import NS_PER_S


def test_each_line_says_how_much_is_left(capsys: pytest.CaptureFixture[str]) -> None:
    """Where no terminal is, each piece that is done is a line with the number done and the time left at this pace."""
    with progress("driving", 5, clock=ManualClock(step_ns=30 * NS_PER_S)) as tell:
        tell("one: completed")
        tell("two: collision")
    assert capsys.readouterr().err.splitlines() == [
        "driving: 5 runs",
        "1 of 5, 2 min left: one: completed",
        "2 of 5, 2 min left: two: collision",
    ]


def test_on_a_terminal_titles_and_lines_are_shown_as_they_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A directory with braces and a reason with brackets are no formats and no markup."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    with progress("sweep into out/{x}[b]", 1) as tell:
        tell("one failed: no space left [/tmp/x]")
    said = capsys.readouterr().err
    assert "sweep into out/{x}[b]" in said
    assert "one failed: no space left [/tmp/x]" in said


@pytest.mark.parametrize(
    ("left_s", "words"), [(0, "0 s left"), (59.4, "59 s left"), (600, "10 min left"), (7200, "2 h left")]
)
def test_the_time_left_is_said_in_round_figures(left_s: float, words: str) -> None:
    """Seconds below a minute, minutes below two hours, then hours."""
    assert left_words(left_s) == words
