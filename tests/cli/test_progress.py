from __future__ import annotations

import sys

import pytest
from tests.support.clocks import ManualClock

from lavt.cli.progress import format_time_left, progress
from lavt.domain import NS_PER_S


def test_each_line_has_the_time_left(capsys: pytest.CaptureFixture[str]) -> None:
    """Without a terminal, each finished run has a line with the number of finished runs and the estimated time left."""
    with progress("driving", 5, clock=ManualClock(step_ns=30 * NS_PER_S)) as report_done:
        report_done("one: completed")
        report_done("two: collision")
    assert capsys.readouterr().err.splitlines() == [
        "driving: 5 runs",
        "1 of 5, 2 min left: one: completed",
        "2 of 5, 2 min left: two: collision",
    ]


def test_titles_and_lines_are_not_parsed_as_markup(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a terminal, braces and brackets in titles and lines are printed unchanged."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    with progress("sweep into out/{x}[b]", 1) as report_done:
        report_done("one failed: no space left [/tmp/x]")
    printed = capsys.readouterr().err
    assert "sweep into out/{x}[b]" in printed
    assert "one failed: no space left [/tmp/x]" in printed


@pytest.mark.parametrize(
    ("left_s", "text"), [(0, "0 s left"), (59.4, "59 s left"), (600, "10 min left"), (7200, "2 h left")]
)
def test_the_time_left_is_rounded(left_s: float, text: str) -> None:
    """The time left is in seconds below a minute, in minutes below two hours, and then in hours."""
    assert format_time_left(left_s) == text
