"""Faults of processes in a drive over CAN, observed from the car: reactions, times, and that no command persists."""

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

Tell = Callable[[str], None]
TestedRun = Callable[[str], RunConfig]
Drive = Callable[..., AbstractContextManager[RunningDrive]]

HOGGING = (str(Path(__file__).with_name("hogging.py")),)
COMMAND_TIMEOUT_MS = 500
"""The server stops the car this long after the last command."""
STATIONARY_MPS = 0.05
BUSY_S = 0.8
"""An actuator that spins uses more of a second; one that waits uses a fifth of it."""
PARKED_MS = 6000
"""Standstill from 5 m/s or more, and park, are reached within this time."""


@pytest.fixture(scope="module")
def tested_run(tmp_path_factory: pytest.TempPathFactory, stalls: Stalls) -> TestedRun:
    """Return a function that returns the run with a profile; the kit's watchdog is tested once."""
    return cache(lambda profile: by_wire.pass_watchdog_test(profile, tmp_path_factory.mktemp("proof"), stalls))


@pytest.fixture
def drive(tested_run: TestedRun, tmp_path: Path, stalls: Stalls) -> Drive:
    """Return a function that drives with a profile, with `lavt` or with another program instead."""
    return lambda profile, program=LAVT: driving(tested_run(profile), tmp_path, stalls, program=program)


@pytest.fixture(autouse=True)
def hogging_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the directory of the files that control `hogging.py`."""
    monkeypatch.setenv("LAVT_HOG", str(tmp_path))


def test_a_route_is_driven_over_can(tell: Tell, drive: Drive) -> None:
    """The server drives the software car over CAN to the end of the route, then parks and disengages it.

    `tests/kernel/test_can.py` drives both generations.
    """
    with drive("dataspeed_gen1") as driven:
        driven.wait(lambda _: driven.loop.server.latest.get("ending") is not None, "the drive does not end")
        if driven.loop.server.latest["ending"] != "completed":
            raise driven.unexpected_stop()
        if os.geteuid() == 0:  # other users may lack the permission
            assert os.getpriority(os.PRIO_PROCESS, driven.actuator_pid) == process_priority.VEHICLE_NICENESS
        ended_ns = CLOCK.now().mono_ns
        parked_ms = driven.car.wait_for_park_ms(ended_ns - NS_PER_S)
        tell(f"parked {parked_ms:.0f} ms after the end of the drive was seen")


@pytest.mark.parametrize("how", ["frozen", "killed", "busy"])
def test_a_stalled_server_stops_the_car(how: str, tmp_path: Path, tell: Tell, drive: Drive) -> None:
    """If the server is frozen, killed or busy, the actuator's process stops, parks and disengages the car."""
    with drive("dataspeed_gen1", HOGGING) as driven:
        server = driven.loop.server.popen
        since_ns = CLOCK.now().mono_ns
        if how == "busy":
            (tmp_path / "hog_server").touch()
        else:
            server.send_signal(signal.SIGSTOP if how == "frozen" else signal.SIGKILL)
        took_ms = driven.car.wait_for_park_ms(since_ns)
        tell(f"server {how}: in park {took_ms:.0f} ms after")
        assert took_ms > COMMAND_TIMEOUT_MS
        driven.require_within(took_ms, PARKED_MS, since_ns, "in park")
        if how == "frozen":
            server.send_signal(signal.SIGCONT)
            pause(NS_PER_S)
            assert driven.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None, "no old command is accepted"
            driven.wait(lambda status: status.get("safety") == "safe_stop", "the server does not report its stop")


@pytest.mark.parametrize(
    ("how", "profile"),
    [("frozen", GENERATIONS[0]), ("frozen", GENERATIONS[1]), ("killed", GENERATIONS[0]), ("busy", GENERATIONS[1])],
)
def test_a_stalled_actuator_leaves_a_braking_car(
    how: str, profile: str, tmp_path: Path, tell: Tell, drive: Drive
) -> None:
    """If the actuator's process does not run no frame is sent, and the kit disengages after 100 ms and brakes."""
    with drive(profile, HOGGING) as driven:
        since_ns = CLOCK.now().mono_ns
        if how == "busy":
            (tmp_path / "hog_actuator").touch()
        else:
            os.kill(driven.actuator_pid, signal.SIGSTOP if how == "frozen" else signal.SIGKILL)
        took_ms = driven.car.wait_for_watchdog_ms(since_ns)
        tell(f"actuator {how}, {profile}: the kit brakes {took_ms:.0f} ms after")
        if how == "frozen":
            os.kill(driven.actuator_pid, signal.SIGCONT)
        if how != "frozen":
            assert driven.loop.server.popen.wait(30) == 1
            reason = {"killed": "has ended", "busy": "does not respond"}[how]
            assert f"the process of the actuator {reason}" in driven.loop.server.last_message()
        else:
            driven.wait(lambda status: status.get("safety") == "safe_stop", "the server does not report its stop")
        assert driven.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None, "no old command is accepted"


@pytest.mark.parametrize("duration_ms", [120, 135, 150])
def test_a_stall_while_parking_ends(duration_ms: int, tell: Tell, drive: Drive) -> None:
    """An actuator that is stopped for a moment while parking reports again, does not spin, and ends with its server.

    The gearbox has a fault, so that parking lasts.
    """
    with drive("dataspeed_gen1") as driven:
        driven.car.execute("fault gear.FLTBUS")
        driven.wait(lambda status: status.get("safety") == "safe_stop", "the server does not report its stop")
        driven.wait(lambda status: abs(status["speed_mps"]) < STATIONARY_MPS, "the car does not stop")
        pause(NS_PER_S)
        if driven.car.braked_ns() is not None:
            raise driven.unexpected_stop()
        since_ns, server = CLOCK.now().mono_ns, driven.loop.server.popen
        os.kill(driven.actuator_pid, signal.SIGSTOP)
        pause(duration_ms * NS_PER_MS)
        os.kill(driven.actuator_pid, signal.SIGCONT)
        driven.car.wait_for_watchdog_ms(since_ns)
        before_s = used_cpu_s(driven.actuator_pid)
        pause(NS_PER_S)
        used_s = used_cpu_s(driven.actuator_pid) - before_s
        tell(f"stopped for {duration_ms} ms while parking: the actuator uses {used_s:.2f} s of the next second")
        assert used_s < BUSY_S
        assert server.poll() is None, "the actuator reports its state"
        server.send_signal(signal.SIGINT)
        assert server.wait(20) == 0
        assert not Path(f"/proc/{driven.actuator_pid}").exists()


def used_cpu_s(pid: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGKILL])
def test_a_stalled_machine_leaves_a_braking_car(how: signal.Signals, tell: Tell, drive: Drive) -> None:
    """If both processes are frozen or killed the kit disengages after 100 ms and brakes, also after they resume."""
    with drive("dataspeed_gen2") as driven:
        since_ns = CLOCK.now().mono_ns
        os.killpg(driven.loop.server.popen.pid, how)
        took_ms = driven.car.wait_for_watchdog_ms(since_ns)
        tell(f"both, {how.name}: the kit brakes {took_ms:.0f} ms after")
        if how == signal.SIGSTOP:
            pause(2 * NS_PER_S)
            os.killpg(driven.loop.server.popen.pid, signal.SIGCONT)
            pause(NS_PER_S)
            assert driven.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None
            driven.wait(lambda status: status.get("safety") != "driving", "the server does not report its stop")


@pytest.mark.parametrize(
    ("command", "safety"),
    [("driver_steers 3", "disarmed"), ("driver_brakes 0.3", "disarmed"), ("fault steering.FLTPWR", "safe_stop")],
)
def test_events_in_the_car_reach_the_server(command: str, safety: str, tell: Tell, drive: Drive) -> None:
    """An override by the driver disengages the car at once, and a fault stops it; the server reports the reason."""
    with drive("dataspeed_gen1") as driven:
        at_ns = driven.car.execute(command)
        released_ns = driven.car.wait("enabled", "released: ", since_ns=at_ns)
        driven.wait(lambda status: status.get("safety") == safety, "the server does not report the event")
        pause(NS_PER_S // 2)
        took_ms = ms_since(released_ns, at_ns)
        tell(f"{command}: first axis released {took_ms:.0f} ms after; {driven.status()['reason']}")
        assert driven.car.event_ns("enabled", "enabled: steering", since_ns=at_ns) is None


def test_a_server_that_ends_parks_the_car(tell: Tell, drive: Drive) -> None:
    """A server that gets Ctrl-C stops, parks and disengages the car, and ends with 0."""
    with drive("dataspeed_gen2") as driven:
        since_ns = CLOCK.now().mono_ns
        driven.loop.server.popen.send_signal(signal.SIGINT)
        tell(f"Ctrl-C: in park {driven.car.wait_for_park_ms(since_ns):.0f} ms after")
        assert driven.loop.server.popen.wait(20) == 0


def test_without_a_watchdog_test_nothing_is_armed(tmp_path: Path, tell: Tell, stalls: Stalls) -> None:
    """Arming is rejected with a reason unless this kit on this bus has passed the watchdog test."""
    run = by_wire.run_config("dataspeed_gen2", tmp_path / "none.json")
    with by_wire.started(run, tmp_path, stalls) as driven:
        driven.wait(lambda status: "watchdog" in status.get("rejected", ""), "the server does not report the reason")
        tell(driven.status()["rejected"])
        pause(2 * NS_PER_S)
        assert driven.status()["safety"] == "disarmed"
        assert driven.car.event_ns("enabled", "enabled: ") is None
