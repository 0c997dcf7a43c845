"""Child processes: how they end with their parent, and what their output and their files can do to it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from lavt.errors import WorkError
from lavt.experiment.runs import processes
from lavt.experiment.runs.processes import Process

WAIT_S = 30.0
WATCHING = """
import signal
from lavt.runtime.parent_watch import end_with_parent
signal.signal(signal.SIGINT, signal.SIG_IGN)
end_with_parent()
print("{}", flush=True)
signal.pause()
"""
HELD = """
import json, subprocess
child = subprocess.Popen(["sleep", "60"])
print(json.dumps({"child": child.pid}), flush=True)
"""


def test_a_process_ends_with_its_parent(tmp_path: Path) -> None:
    """When the parent's end of the pipe closes, as after SIGKILL, the child is stopped, even if it ignores Ctrl-C."""
    process = Process("child", (), tmp_path, ("-c", WATCHING))
    process.wait_ready()
    assert process.running
    assert process.popen.stdin is not None
    process.popen.stdin.close()
    assert process.popen.wait(WAIT_S) == -signal.SIGTERM
    process.end()


def test_a_process_that_holds_the_output_open_delays_no_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The end of a process does not wait for a process that it has started and that still has its output open."""
    monkeypatch.setattr(processes, "OUTPUT_LIMIT_S", 0.1)
    process = Process("parent", (), tmp_path, ("-c", HELD))
    child = process.wait_ready()["child"]
    try:
        process.end()
        assert process.last_line() == {"child": child}
        os.kill(child, 0)  # raises an error if the child has ended
    finally:
        os.kill(child, signal.SIGKILL)
        process._reader.join(WAIT_S)


def test_a_process_that_is_killed_during_its_start_names_the_signal(tmp_path: Path) -> None:
    """If a signal ends a process before it is ready, as for lack of memory, the error gives the signal."""
    process = Process("child", (), tmp_path, ("-c", "import os; os.kill(os.getpid(), 9)"))
    with pytest.raises(WorkError, match="child was ended by signal 9 during its start: no message"):
        process.wait_ready()
    process.end()


def test_a_deleted_log_has_no_last_message(tmp_path: Path) -> None:
    """If the directory of a process is deleted, its last message is unknown, which is no error."""
    process = Process("child", (), tmp_path, ("-c", "import sys; sys.exit('the last line')"))
    process.popen.wait(WAIT_S)
    assert process.last_message() == "the last line"
    (tmp_path / "child.log").unlink()
    assert process.last_message() == "no message"
    process.end()
