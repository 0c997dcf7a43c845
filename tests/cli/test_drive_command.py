from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from tests.support.command_line import Run

from lavt.cli import drive as drive_command

pytest.importorskip("websockets")


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_during_the_start_removes_the_temporary_files(
    signal_number: signal.Signals, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    """Ctrl-C, SIGTERM or a closed terminal while the server starts ends `lavt drive` with code 130, and cleans up."""
    ended: list[str] = []

    @contextmanager
    def start(*_: object) -> Iterator[None]:
        try:
            assert signal.getsignal(signal_number) != signal.SIG_DFL, "the signal would kill the process"
            signal.raise_signal(signal_number)
            yield
        finally:
            ended.append("cleaned up")

    former_handler = signal.signal(signal_number, signal.default_int_handler if signal_number == 2 else signal.SIG_DFL)
    try:
        monkeypatch.setattr(drive_command, "start_human_drive", start)
        result = run("drive", "--no-browser")
    finally:
        signal.signal(signal_number, former_handler)
    assert (result.code, ended) == (130, ["cleaned up"])
    assert "Traceback" not in result.err
