"""Drives in real time in a stand-in for a CARLA server."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import pytest
from tests.carla.stand_in import StandIn, stand_in
from tests.support.stalls import LONG_STALL_MS, Stalls

from lavt.clock import MachineClock
from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_MS
from lavt.errors import LavtError
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.runs.run import run_once
from lavt.recording.record import Record, read_record

PICTURE = ("320", "240")
TIME_LIMIT_S = 6.0
MEDIAN_ERROR_MS = 2.0
MIN_LATE_SHARE = 0.2
DRIVES_MPS = 1.0


@dataclass(frozen=True)
class TimedDrive:
    """A finished drive: the server's record, when the world was ticked, and when the drive took place."""

    record: Record
    tick_times_ns: list[int]
    began_ns: int
    ended_ns: int


def planned(server: StandIn, time_limit_s: float, *more: str) -> PlannedRun:
    changes = (
        "time=real",
        "vehicle.kind=carla",
        f"vehicle.carla.port={server.port}",
        "vehicle.carla.timeout_s=30.0",
        f"vehicle.time_limit_s={time_limit_s}",
        f"camera.width_px={PICTURE[0]}",
        f"camera.height_px={PICTURE[1]}",
        *more,
    )
    return plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TimedDrive:
    """Drive for some seconds."""
    out = tmp_path_factory.mktemp("carla") / "run"
    clock = MachineClock()
    with stand_in("--scenery", "none", "--camera", *PICTURE) as server:
        began_ns = clock.now().mono_ns
        run_once(planned(server, TIME_LIMIT_S), out)
        ended_ns = clock.now().mono_ns
        tick_times_ns = [int(text) for text in server.ask("tick_times").split()]
        assert server.ask("actors") == ""
    return TimedDrive(read_record(out / "server.mcap"), tick_times_ns, began_ns, ended_ns)


def test_the_car_drives_and_is_removed(drive: TimedDrive, stalls: Stalls) -> None:
    """The drive begins and the car moves; afterwards no actor of it is left in the world."""
    assert "drive_began" in drive.record.table("event").texts("kind")
    with stalls.excusing_failures(drive.began_ns, drive.ended_ns):  # a stall can stop the car
        assert max(drive.record.table("truth").floats("progress_m")) > 5.0


def test_capture_times_are_those_of_the_ticks(drive: TimedDrive, stalls: Stalls) -> None:
    """The median difference between a frame's capture time and its tick is at most 2 ms, or late ticks are counted."""
    capture_ns = drive.record.table("frame").ints("capture_ns").tolist()
    assert len(capture_ns) > 30
    errors_ms = [min(abs(at_ns - tick_ns) for tick_ns in drive.tick_times_ns) / NS_PER_MS for at_ns in capture_ns]
    late = max(drive.record.table("counts").ints("carla_ticks_begun_late").tolist())
    with stalls.excusing_failures(drive.began_ns, drive.ended_ns, stall_ms=LONG_STALL_MS):
        assert median(errors_ms) <= MEDIAN_ERROR_MS or late > MIN_LATE_SHARE * len(drive.tick_times_ns)


def test_a_server_killed_during_a_drive_ends_the_run(tmp_path: Path) -> None:
    """If the CARLA server is killed during a drive, the run ends with an error that names the server."""
    with stand_in("--scenery", "none", "--camera", *PICTURE) as server:
        has_ended = threading.Event()

        def kill_when_it_drives() -> None:
            while not has_ended.wait(0.1):
                if max(map(float, server.ask("speed").split()), default=0.0) > DRIVES_MPS:
                    server.kill()
                    return

        killer = threading.Thread(target=kill_when_it_drives)
        killer.start()
        try:
            with pytest.raises(LavtError, match="CARLA server"):
                run_once(planned(server, 60.0, "vehicle.carla.tick_timeout_s=2.0"), tmp_path / "run")
        finally:
            has_ended.set()
            killer.join()
        assert server.process.returncode is not None, "the run ended before the server was killed"
