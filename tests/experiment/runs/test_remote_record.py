"""The record that a remote server sends: what is wrong with it fails the run, so that the run is driven again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from lavt.errors import WorkError
from lavt.experiment.runs.remote_run import check_record

MakeRun = Callable[..., Path]


def test_a_complete_record_is_accepted(make_run: MakeRun, tmp_path: Path) -> None:
    """The record of the client's own drive passes."""
    run = make_run(tmp_path)
    check_record(run / "server.mcap", run / "client.mcap")


def test_an_incomplete_record_fails_the_run(make_run: MakeRun, tmp_path: Path) -> None:
    """A record without its end, as a full disk leaves it, is not a result."""
    run = make_run(tmp_path)
    record = run / "server.mcap"
    record.write_bytes(record.read_bytes()[:-100])
    with pytest.raises(WorkError, match="disk"):
        check_record(record, run / "client.mcap")


@pytest.mark.parametrize("content", [b"", bytes(1000)])
def test_a_damaged_record_fails_the_run(make_run: MakeRun, tmp_path: Path, content: bytes) -> None:
    """Bytes that are no record are a failure of the run; the reason names no temporary file."""
    run = make_run(tmp_path)
    (run / "server.mcap").write_bytes(content)
    with pytest.raises(WorkError) as raised:
        check_record(run / "server.mcap", run / "client.mcap")
    assert str(tmp_path) not in str(raised.value)
