"""Fixtures that run `lavt` in the test's own process."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2  # noqa: F401 (its first import changes the environment, which no test may do)
import pytest
from tests.support.command_line import CommandResult, Run

from lavt.cli import console
from lavt.cli.main import main
from lavt.runtime import process_priority


@pytest.fixture(autouse=True)
def unqueued_output(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep commands from queueing their output, which would redirect pytest's."""
    monkeypatch.setattr(console, "queue_output", lambda *_: None)


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    own_switch_interval: None,  # noqa: ARG001 (some commands change it)
) -> Run:
    """Return a function that runs `lavt` in this process, from an empty working directory."""
    monkeypatch.setattr(console, "reserve_stdout", lambda: None)  # would redirect pytest's output
    monkeypatch.setattr(process_priority, "raise_priority", lambda *_: None)  # would affect all tests
    monkeypatch.chdir(tmp_path)

    def run_here(*arguments: str) -> CommandResult:
        monkeypatch.setattr(sys, "argv", ["lavt", *arguments])
        with pytest.raises(SystemExit) as raised:
            main()
        output = capsys.readouterr()
        code = raised.value.code
        return CommandResult(code if isinstance(code, int) else 0, output.out, output.err)

    return run_here
