"""Faults of processes in a drive over CAN, observed from the car: how and when the car reacts, and that no old command
is executed.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path

import pytest
from tests.field import by_wire
from tests.field.by_wire import CLOCK, GENERATIONS, RunningDrive, driving, ms_since
from tests.support.stalls import Stalls

from lavt.clock import pause
from lavt.config import RunConfig
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import LAVT
from lavt.runtime import process_priority

pytest.importorskip("can")
pytestmark = [pytest.mark.timeout(600)]

PrintReport = Callable[[str], None]
TestedRun = Callable[[str], RunConfig]
DriveWithProfile = Callable[..., AbstractContextManager[RunningDrive]]

BLOCKABLE_LAVT = (str(Path(__file__).with_name("hogging.py")),)
"""`lavt`, with a thread that blocks the interpreter as soon as the test creates a file."""
COMMAND_TIMEOUT_MS = 500
"""The server stops the car this long after the last command."""
STATIONARY_MPS = 0.05
BUSY_S = 0.8
"""An actuator that spins uses more processor time than this in a second; one that waits uses a fifth of this."""
PARKING_STALL_MS = 135
"""Time for which the actuator is suspended while it parks the car."""
PARKING_LIMIT_MS = 6000
"""A car that drives at 5 m/s or more is stationary and in park within this time."""


@pytest.fixture(scope="module")
def tested_run(tmp_path_factory: pytest.TempPathFactory, stalls: Stalls) -> TestedRun:
    """Return a function that returns the run with a profile; its first call for a profile tests the kit's watchdog."""
    return cache(lambda profile: by_wire.pass_watchdog_test(profile, tmp_path_factory.mktemp("proof"), stalls))


@pytest.fixture
def drive(tested_run: TestedRun, tmp_path: Path, stalls: Stalls) -> DriveWithProfile:
    """Return a function that drives with a profile, with `lavt` or with another program instead."""
    return lambda profile, program=LAVT: driving(tested_run(profile), tmp_path, stalls, program=program)


@pytest.fixture(autouse=True)
def hogging_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the directory of the files that control `hogging.py`."""
    monkeypatch.setenv("LAVT_HOG", str(tmp_path))


@pytest.mark.parametrize("fault", ["frozen", "busy"])
def test_a_stalled_server_stops_the_car(
    fault: str, tmp_path: Path, print_report: PrintReport, drive: DriveWithProfile
) -> None:
    """If the server is frozen or busy, the actuator's process stops, parks and disengages the car.

    `tests/kernel/test_can.py` kills the server.
    """
    with drive("dataspeed_gen1", BLOCKABLE_LAVT) as drive_in_progress:
        server_process = drive_in_progress.loop.server.popen
        since_ns = CLOCK.now().mono_ns
        if fault == "busy":
            (tmp_path / "hog_server").touch()
        else:
            server_process.send_signal(signal.SIGSTOP)
        took_ms = drive_in_progress.car.wait_for_park_ms(since_ns)
        print_report(f"server {fault}: in park after {took_ms:.0f} ms")
        assert took_ms > COMMAND_TIMEOUT_MS
        drive_in_progress.require_within(took_ms, PARKING_LIMIT_MS, since_ns, "in park")
        if fault == "frozen":
            server_process.send_signal(signal.SIGCONT)
            pause(NS_PER_S)
            assert not drive_in_progress.car.was_enabled(since_ns), "the kit accepted an old command"
            drive_in_progress.wait(
                lambda status: status.get("safety") == "safe_stop", "the server does not report its stop"
            )


@pytest.mark.parametrize(
    ("fault", "profile", "reason"),
    [("killed", GENERATIONS[1], "has ended"), ("busy", GENERATIONS[0], "does not respond")],
)
def test_a_stalled_actuator_leaves_a_braking_car(
    fault: str, profile: str, reason: str, *, tmp_path: Path, print_report: PrintReport, drive: DriveWithProfile
) -> None:
    """If the actuator's process does not run, the kit disengages and brakes after 100 ms, and stays disengaged.

    `tests/kernel/test_can.py` freezes the process.
    """
    with drive(profile, BLOCKABLE_LAVT) as drive_in_progress:
        since_ns = CLOCK.now().mono_ns
        if fault == "busy":
            (tmp_path / "hog_actuator").touch()
        else:
            os.kill(drive_in_progress.actuator_pid, signal.SIGKILL)
        took_ms = drive_in_progress.car.wait_for_watchdog_ms(since_ns)
        print_report(f"actuator {fault}, {profile}: the kit brakes after {took_ms:.0f} ms")
        assert drive_in_progress.loop.server.popen.wait(30) == 1
        assert f"the process of the actuator {reason}" in drive_in_progress.loop.server.last_message()
        assert not drive_in_progress.car.was_enabled(since_ns), "the kit accepted an old command"


def test_a_stall_while_parking_ends(print_report: PrintReport, drive: DriveWithProfile) -> None:
    """An actuator that is suspended briefly while it parks then reports, does not spin, and ends with its server.

    The gearbox has a fault, so that the actuator keeps trying to park. `tests/vehicle/dbw/test_adapter_stalls.py` has
    stalls of every duration.
    """
    with drive("dataspeed_gen1") as drive_in_progress:
        drive_in_progress.car.execute("fault gear.FLTBUS")
        drive_in_progress.wait(
            lambda status: status.get("safety") == "safe_stop", "the server does not report its stop"
        )
        drive_in_progress.wait(lambda status: abs(status["speed_mps"]) < STATIONARY_MPS, "the car does not stop")
        pause(NS_PER_S)
        if drive_in_progress.car.watchdog_braked_ns() is not None:
            raise drive_in_progress.unexpected_stop()
        since_ns, server = CLOCK.now().mono_ns, drive_in_progress.loop.server.popen
        os.kill(drive_in_progress.actuator_pid, signal.SIGSTOP)
        pause(PARKING_STALL_MS * NS_PER_MS)
        os.kill(drive_in_progress.actuator_pid, signal.SIGCONT)
        drive_in_progress.car.wait_for_watchdog_ms(since_ns)
        before_s = used_cpu_s(drive_in_progress.actuator_pid)
        pause(NS_PER_S)
        used_s = used_cpu_s(drive_in_progress.actuator_pid) - before_s
        print_report(
            f"suspended for {PARKING_STALL_MS} ms while parking: the actuator uses {used_s:.2f} s of the next second"
        )
        assert used_s < BUSY_S
        assert server.poll() is None, "the server ended, so the actuator did not report its state"
        server.send_signal(signal.SIGINT)
        assert server.wait(20) == 0
        assert not Path(f"/proc/{drive_in_progress.actuator_pid}").exists()


def used_cpu_s(pid: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    user_ticks, system_ticks = int(fields[11]), int(fields[12])
    return (user_ticks + system_ticks) / os.sysconf("SC_CLK_TCK")


def test_a_stalled_machine_leaves_a_braking_car(print_report: PrintReport, drive: DriveWithProfile) -> None:
    """If both processes are frozen, the kit disengages and brakes after 100 ms, and stays disengaged."""
    with drive("dataspeed_gen2") as drive_in_progress:
        since_ns = CLOCK.now().mono_ns
        for pid in drive_in_progress.pids:
            os.kill(pid, signal.SIGSTOP)
        took_ms = drive_in_progress.car.wait_for_watchdog_ms(since_ns)
        print_report(f"server and actuator frozen: the kit brakes after {took_ms:.0f} ms")
        pause(2 * NS_PER_S)
        for pid in drive_in_progress.pids:
            os.kill(pid, signal.SIGCONT)
        pause(NS_PER_S)
        assert not drive_in_progress.car.was_enabled(since_ns)
        drive_in_progress.wait(lambda status: status.get("safety") != "driving", "the server does not report its stop")


@pytest.mark.parametrize(
    ("command", "safety"),
    [("driver_brakes 0.3", "disarmed"), ("fault steering.FLTPWR", "safe_stop")],
)
def test_events_in_the_car_reach_the_server(
    command: str, safety: str, print_report: PrintReport, drive: DriveWithProfile
) -> None:
    """The driver's override disengages the car at once, and a fault stops it; the server reports the reason."""
    with drive("dataspeed_gen1") as drive_in_progress:
        at_ns = drive_in_progress.car.execute(command)
        released_ns = drive_in_progress.car.wait(kind="enabled", text="released: ", since_ns=at_ns)
        drive_in_progress.wait(lambda status: status.get("safety") == safety, "the server does not report the event")
        pause(NS_PER_S // 2)
        took_ms = ms_since(released_ns, at_ns)
        print_report(f"{command}: first axis released after {took_ms:.0f} ms; {drive_in_progress.status()['reason']}")
        assert drive_in_progress.car.event_ns("enabled", "enabled: steering", since_ns=at_ns) is None


@pytest.mark.parametrize("stuck_mps", [0, 3])
def test_a_car_whose_speed_report_is_stuck_stops(
    stuck_mps: int, print_report: PrintReport, drive: DriveWithProfile
) -> None:
    """A car whose reported speed is stuck is stopped, and is not put into park while it moves."""
    with drive("dataspeed_gen1") as drive_in_progress:
        since_ns = drive_in_progress.car.execute(f"stick_speed speed={stuck_mps}")
        drive_in_progress.wait(
            lambda status: status.get("safety") == "safe_stop", "the server does not report its stop"
        )
        progress_m: list[float] = [drive_in_progress.status()["progress_m"]]
        while len(progress_m) < 2 or progress_m[-1] - progress_m[-2] > STATIONARY_MPS:
            assert drive_in_progress.car.event_ns("gear", "gear PARK", since_ns=since_ns) is None
            pause(NS_PER_S)
            progress_m.append(drive_in_progress.status()["progress_m"])
        print_report(f"speed stuck at {stuck_mps} m/s: stopped {progress_m[-1] - progress_m[0]:.1f} m later")
        assert drive_in_progress.status()["reason"]


def test_a_server_that_ends_parks_the_car(print_report: PrintReport, drive: DriveWithProfile) -> None:
    """A server that gets Ctrl-C stops, parks and disengages the car, and ends with 0.

    `tests/kernel/test_can.py` drives both generations to the end of a route.
    """
    with drive("dataspeed_gen2") as drive_in_progress:
        if os.geteuid() == 0:  # other users may lack the permission
            assert os.getpriority(os.PRIO_PROCESS, drive_in_progress.actuator_pid) == process_priority.VEHICLE_NICENESS
            assert os.getsid(drive_in_progress.actuator_pid) == drive_in_progress.actuator_pid
        since_ns = CLOCK.now().mono_ns
        drive_in_progress.loop.server.popen.send_signal(signal.SIGINT)
        print_report(f"Ctrl-C: in park after {drive_in_progress.car.wait_for_park_ms(since_ns):.0f} ms")
        assert drive_in_progress.loop.server.popen.wait(20) == 0


def test_without_a_watchdog_test_nothing_is_armed(tmp_path: Path, print_report: PrintReport, stalls: Stalls) -> None:
    """Arming is rejected with a reason unless this kit on this bus has passed the watchdog test."""
    run = by_wire.run_config("dataspeed_gen2", tmp_path / "none.json")
    with by_wire.running_drive(run, tmp_path, stalls) as drive_in_progress:
        drive_in_progress.wait(
            lambda status: "watchdog" in status.get("rejected", ""), "the server does not report the reason"
        )
        print_report(drive_in_progress.status()["rejected"])
        pause(2 * NS_PER_S)
        assert drive_in_progress.status()["safety"] == "disarmed"
        assert not drive_in_progress.car.was_enabled()
