from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from lavt.cli import demo as demo_command
from lavt.cli.demo import closing_sentences, describe_ending, own_lane_text, summary_table
from lavt.cli.live_view import _status_line
from lavt.errors import WorkError


def run_of(condition: str, time: str = "real", *, kept: bool | None = True, **changes: Any) -> dict[str, Any]:
    run = {
        "time": time,
        "condition": condition,
        "ending": "completed",
        "valid": True,
        "invalid_reasons": [],
        "completed_in_own_lane": kept,
        "injected_ms": {"video": 225.0, "control": 100.0},
        "loop_ms": {"p50": 341.2},
        "p95_m": 3.5,
    }
    return {**run, **changes}


def condition_of(kept: int, injected_ms: float) -> dict[str, Any]:
    return {
        "runs": 6,
        "completed_in_own_lane": kept,
        "own_lane_completion_interval": [0.54, 1.0] if kept else [0.0, 0.46],
        "injected_ms": {"video": injected_ms, "control": 0.0},
        "loop_ms": {"p50": 7.0 + injected_ms},
        "by_road": {"p95_all_runs_m": {"mean": 0.05}},
    }


def summary_of(*runs: dict[str, Any]) -> dict[str, Any]:
    return {"conditions": {"L0": condition_of(6, 0.0), "L5": condition_of(0, 225.0)}, "runs": list(runs)}


BUSY = {"code": "frames_missed", "text": "31 frames were not made"}


def test_the_demo_ends_with_three_sentences() -> None:
    """The sentences give what was shown, by the own lane and with intervals, what was not shown, and what is valid."""
    stopped = run_of("L5", ending="safe_stop", kept=False)
    shown, not_shown, valid = closing_sentences(summary_of(run_of("L0"), stopped))
    assert "6 of 6 (54 to 100 %)" in shown
    assert "0 of 6 (0 to 46 %)" in shown
    assert shown.endswith("L0 completed in its own lane; L5 safe stop.")
    assert not_shown.startswith("Not shown:")
    assert "Khalil and Kwon, 2026" in not_shown
    assert valid == "Valid: all 2 runs."


def test_an_invalid_run_is_explained() -> None:
    """The last sentence says why a run in real time is not valid; the first one leaves it out."""
    shown, _, valid = closing_sentences(summary_of(run_of("L0", valid=False, invalid_reasons=[BUSY]), run_of("L5")))
    assert "L0 completed" not in shown
    assert valid.startswith("Valid: 1 of 2 runs;")
    assert "real time, L0: 31 frames were not made" in valid
    assert "A busy machine" in valid


def test_a_run_in_another_lane_is_not_called_completed() -> None:
    """The ending of a run says in which lane it was completed, and why it is not valid."""
    assert describe_ending(run_of("L5", kept=False)) == "completed, but not in its own lane"
    assert describe_ending(run_of("L5", kept=None)) == "completed"
    assert describe_ending(run_of("L5", ending="off_road", valid=False, invalid_reasons=[BUSY])) == (
        "off road (not valid: 31 frames were not made)"
    )


def test_the_table_fits_into_80_columns() -> None:
    """The table has all its cells, none broken, on a terminal of 80 columns, also for invalid runs."""
    invalid = run_of("L5", ending="safe_stop", kept=False, valid=False, invalid_reasons=[BUSY])
    console = Console(width=80)
    with console.capture() as capture:
        console.print(summary_table(summary_of(run_of("L0"), invalid)))
    lines = capture.get().splitlines()
    assert all(len(line) <= 80 for line in lines)
    for text in ("6 of 6 (54 to 100 %)", "225 + 100", "no: safe stop; not valid", "video + control", "95 % interval"):
        assert any(text in line for line in lines)


def test_an_unknown_lane_is_unknown() -> None:
    """Without a valid run there is no share of completed runs."""
    assert own_lane_text({"own_lane_completion_interval": None}) == "unknown"


def test_the_live_view_shows_what_the_driver_sees() -> None:
    """The live view has speed, latency, error, and whether the newest picture has a lane."""
    server = {"speed_mps": 8.0, "safety": "driving", "cross_track_m": -0.5}
    assert "28.8 km/h" in _status_line(server, {})
    assert "lane seen  71 %" in _status_line(server, {"lane_confidence": 0.71})
    assert "no lane seen" in _status_line(server, {"lane_confidence": 0.0})


def test_ctrl_c_in_the_virtual_part_says_what_is_finished(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Ctrl-C during the runs in virtual time says that the runs in progress are finished first."""

    def interrupt(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(demo_command, "_drive_real", lambda *_: None)
    monkeypatch.setattr(demo_command, "_drive_virtual", interrupt)
    with pytest.raises(WorkError, match="stopped"):
        demo_command.demo(tmp_path / "out")
    assert "finishing the runs in progress; Ctrl-C again ends at once" in capsys.readouterr().err
