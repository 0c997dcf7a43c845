from __future__ import annotations

import threading
from pathlib import Path

import pytest

from lavt.assembly.side import open_client
from lavt.clock import MachineClock
from lavt.config import ClientClockConfig, ClientConfig, ZenohConfig
from lavt.recording.record import read_record
from lavt.transport.netem.injector import Injector


class PartFailed(Exception):
    """A part of a side cannot be closed."""


@pytest.mark.usefixtures("own_switch_interval")  # the side's runtime sets the switch interval of threads
def test_a_failing_close_of_one_part_leaves_no_other_part_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If closing one part fails, all other parts are closed, the record is complete, and the error is raised."""
    real_close = Injector.close

    def fail(injector: Injector) -> None:
        real_close(injector)
        raise PartFailed

    monkeypatch.setattr(Injector, "close", fail)
    config = ClientConfig(zenoh=ZenohConfig(router="tcp/127.0.0.1:1"), clock=ClientClockConfig(source="probe"))
    before, out = set(threading.enumerate()), tmp_path / "out"
    with pytest.raises(PartFailed), open_client(config, out, MachineClock(), lambda _: None) as side:
        side.start()
    assert set(threading.enumerate()) == before
    assert read_record(out / "client.mcap").complete
