"""Faults of processes in a drive over CAN, seen from the car: what happens, how soon, and that no command stands."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path

import pytest
from tests.field import by_wire
from tests.field.by_wire import CLOCK, GENERATIONS, Driven, driving, ms_since
from tests.support.stalls import Stalls

from lavt.clock import pause
from lavt.config import RunConfig
from lavt.domain import NS_PER_S
from lavt.experiment.runs.processes import LAVT
from lavt.runtime import process_priority

pytest.importorskip("can")
pytestmark = [pytest.mark.timeout(600)]

Tell = Callable[[str], None]
Proved = Callable[[str], RunConfig]
Drive = Callable[..., AbstractContextManager[Driven]]

HOGGING = (str(Path(__file__).with_name("hogging.py")),)
SILENCE_MS = 500
"""The vehicle's side stops so long after the last command."""
PARKED_MS = 6000
"""Standstill from 5 m/s and more, and park, come within this time."""


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory, stalls: Stalls) -> Proved:
    """Give the run with a profile; that the kit's watchdog brakes is proved once."""
    return cache(lambda profile: by_wire.proved(profile, tmp_path_factory.mktemp("proof"), stalls))


@pytest.fixture
def drive(proved: Proved, tmp_path: Path, stalls: Stalls) -> Drive:
    """Give a way to drive with a profile, with `lavt` or another program for it."""
    return lambda profile, program=LAVT: driving(proved(profile), tmp_path, stalls, program=program)


@pytest.fixture(autouse=True)
def signs_of_hogging(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Say where the signs for `hogging.py` are."""
    monkeypatch.setenv("LAVT_HOG", str(tmp_path))


def test_a_route_is_driven_over_can(tell: Tell, drive: Drive) -> None:
    """The server drives the software car over CAN to the end of the route, then parks it and lets go.

    `tests/kernel/test_can.py` drives both generations.
    """
    with drive("dataspeed_gen1") as driven:
        driven.wait(lambda _: driven.loop.server.latest.get("ending") is not None, "the drive does not end")
        if driven.loop.server.latest["ending"] != "completed":
            raise driven.stopped_wrongly()
        if os.geteuid() == 0:  # others may not have it
            assert os.getpriority(os.PRIO_PROCESS, driven.actuator_pid) == process_priority.VEHICLE_NICENESS
        ended_ns = CLOCK.now().mono_ns
        tell(f"parked {driven.car.parked(ended_ns - NS_PER_S):.0f} ms after the end of the drive was seen")


@pytest.mark.parametrize("how", ["frozen", "killed", "busy"])
def test_a_server_that_stands_still_stops_the_car(how: str, tmp_path: Path, tell: Tell, drive: Drive) -> None:
    """Frozen, killed, or held by a thread of its own: the actuator's process stops the car, parks it and lets go."""
    with drive("dataspeed_gen1", HOGGING) as driven:
        server = driven.loop.server.popen
        since_ns = CLOCK.now().mono_ns
        if how == "busy":
            (tmp_path / "hog_server").touch()
        else:
            server.send_signal(signal.SIGSTOP if how == "frozen" else signal.SIGKILL)
        took_ms = driven.car.parked(since_ns)
        tell(f"server {how}: in park {took_ms:.0f} ms after")
        assert took_ms > SILENCE_MS
        driven.in_time(took_ms, PARKED_MS, since_ns, "in park")
        if how == "frozen":
            server.send_signal(signal.SIGCONT)
            pause(NS_PER_S)
            assert driven.car.heard("enabled", "obeys: ", since_ns=since_ns) is None, "nothing of before is obeyed"
            driven.wait(lambda status: status.get("safety") == "safe_stop", "the server does not say that it stopped")


@pytest.mark.parametrize(
    ("how", "profile"),
    [("frozen", GENERATIONS[0]), ("frozen", GENERATIONS[1]), ("killed", GENERATIONS[0]), ("busy", GENERATIONS[1])],
)
def test_an_actuator_that_stands_still_leaves_a_braking_car(
    how: str, profile: str, tmp_path: Path, tell: Tell, drive: Drive
) -> None:
    """No frame leaves an actuator's process that does not run: the kit lets go after 100 ms, and brakes."""
    with drive(profile, HOGGING) as driven:
        since_ns = CLOCK.now().mono_ns
        if how == "busy":
            (tmp_path / "hog_actuator").touch()
        else:
            os.kill(driven.actuator_pid, signal.SIGSTOP if how == "frozen" else signal.SIGKILL)
        took_ms = driven.car.held(since_ns)
        tell(f"actuator {how}, {profile}: the kit brakes {took_ms:.0f} ms after")
        if how == "frozen":
            os.kill(driven.actuator_pid, signal.SIGCONT)
        if how == "killed":
            assert driven.loop.server.popen.wait(30) == 1
            assert "the process of the actuator has ended" in driven.loop.server.said()
        else:
            driven.wait(lambda status: status.get("safety") == "safe_stop", "the server does not say that it stopped")
        assert driven.car.heard("enabled", "obeys: ", since_ns=since_ns) is None, "nothing of before is obeyed"


@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGKILL])
def test_a_machine_that_stands_still_leaves_a_braking_car(how: signal.Signals, tell: Tell, drive: Drive) -> None:
    """With both processes frozen or killed the kit lets go after 100 ms, and brakes; thawed, nothing is obeyed."""
    with drive("dataspeed_gen2") as driven:
        since_ns = CLOCK.now().mono_ns
        os.killpg(driven.loop.server.popen.pid, how)
        took_ms = driven.car.held(since_ns)
        tell(f"both, {how.name}: the kit brakes {took_ms:.0f} ms after")
        if how == signal.SIGSTOP:
            pause(2 * NS_PER_S)
            os.killpg(driven.loop.server.popen.pid, signal.SIGCONT)
            pause(NS_PER_S)
            assert driven.car.heard("enabled", "obeys: ", since_ns=since_ns) is None
            driven.wait(lambda status: status.get("safety") != "driving", "the server does not say that it stopped")


@pytest.mark.parametrize(
    ("words", "safety"),
    [("driver_steers 3", "disarmed"), ("driver_brakes 0.3", "disarmed"), ("fault steering.FLTPWR", "safe_stop")],
)
def test_what_happens_in_the_car_reaches_the_server(words: str, safety: str, tell: Tell, drive: Drive) -> None:
    """A driver who takes over has the car at once, and a fault stops it; the server says so in words."""
    with drive("dataspeed_gen1") as driven:
        at_ns = driven.car.act(words)
        released_ns = driven.car.wait("enabled", "lets go", since_ns=at_ns)
        driven.wait(lambda status: status.get("safety") == safety, "the server does not say what happened")
        pause(NS_PER_S // 2)
        tell(f"{words}: first axis let go {ms_since(released_ns, at_ns):.0f} ms after; {driven.status()['reason']}")
        assert driven.car.heard("enabled", "obeys: steering", since_ns=at_ns) is None


def test_a_server_that_is_told_to_end_parks_the_car(tell: Tell, drive: Drive) -> None:
    """Ctrl-C on the server stops the car, parks it and lets go, and ends with 0."""
    with drive("dataspeed_gen2") as driven:
        since_ns = CLOCK.now().mono_ns
        driven.loop.server.popen.send_signal(signal.SIGINT)
        tell(f"told to end: in park {driven.car.parked(since_ns):.0f} ms after")
        assert driven.loop.server.popen.wait(20) == 0


def test_without_a_proof_that_the_watchdog_brakes_nothing_is_armed(tmp_path: Path, tell: Tell, stalls: Stalls) -> None:
    """Arming is refused, in words, unless it was proved that this kit on this bus brakes when nothing is sent."""
    run = by_wire.run_config("dataspeed_gen2", tmp_path / "none.json")
    with by_wire.started(run, tmp_path, stalls) as driven:
        driven.wait(lambda status: "watchdog" in status.get("rejected", ""), "the server does not say why")
        tell(driven.status()["rejected"])
        pause(2 * NS_PER_S)
        assert driven.status()["safety"] == "disarmed"
        assert driven.car.heard("enabled", "obeys: ") is None
