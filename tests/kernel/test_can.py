"""`lavt server` drives a software car over the kernel's own CAN, with the client on another machine.

The vehicle's machine, of one processor, runs server, actuator and software car; router and client run on the other one.
"""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import struct
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from tests.field.by_wire import (
    GENERATIONS,
    KIT_MS,
    ROOM_MS,
    SoftwareCarProcess,
    ms_since,
    software_car,
)
from tests.kernel.lane import processes
from tests.kernel.lane.driving import BY_WIRE, Loop, collect, start_by_wire, wait_for_the_end
from tests.kernel.lane.machine import Machine, MachineError, wait_until
from tests.kernel.lane.verdicts import (
    KIT_STALL_MS,
    changes_of_safety,
    least_stop_ms,
    or_too_slow,
    require_completed,
    require_valid,
)
from tests.support.stalls import Stalls

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.dbw.bus import CanPort

pytestmark = [pytest.mark.timeout(900), pytest.mark.usefixtures("vcan")]

Tell = Callable[[str], None]

SMALL = ("camera.width_px=320", "camera.height_px=240", "camera.rate_hz=15")
"""A user-mode kernel has one processor and dear system calls."""
P95_M = 0.22
COMMANDS = {0x200, 0x201, 0x202}
"""Steering, brake and throttle, of generation 2's set `remote`."""
SENT_LATE_MS = 20
SET_FLAGS = 0x8914
"""SIOCSIFFLAGS of linux/sockios.h."""
PARKED_MS = 6000
DRIVEN_MPS = 5.0
CLOCK = MachineClock()


@pytest.fixture
def vcan() -> Iterator[None]:
    """The interface that the config names, up."""
    ip("link", "add", "vcan0", "type", "vcan")
    ip("link", "set", "vcan0", "up")
    yield
    subprocess.run(["ip", "link", "delete", "vcan0"], check=False)


def take_down(interface: str) -> None:
    """As `ip link set INTERFACE down` does, without starting a program, which holds a user-mode kernel up."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, SET_FLAGS, struct.pack("16sh14x", interface.encode(), 0))


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


def by_wire(profile: str, work: Path) -> tuple[str, ...]:
    """Changes of the server's config, which are the software car's too."""
    return (
        f"vehicle.dbw.profile={profile}",
        "vehicle.dbw.steering_sign=1",
        f"vehicle.dbw.watchdog_proof={work / f'{profile}.json'}",
        "clock.source=probe",
        "video.bit_rate_bps=1000000",
        "record.video=false",
        *SMALL,
    )


def sets(changes: tuple[str, ...]) -> list[str]:
    return [part for change in changes for part in ("--set", change)]


def prove(machine: Machine, changes: tuple[str, ...], stalls: Stalls) -> None:
    """Let `lavt can test-watchdog` see that the kit's watchdog brakes."""
    with software_car(BY_WIRE, *sets(changes)) as car:
        since_ns = CLOCK.now().mono_ns
        try:
            machine.run([machine.python, "-B", "-m", "lavt", "can", "test-watchdog", BY_WIRE, *sets(changes), "--yes"])
        except MachineError as failed:
            said = f"{failed}, {car.events}"
            raise stalls.verdict(said, since_ns, CLOCK.now().mono_ns, stall_ms=KIT_STALL_MS) from None


@dataclass
class Driven:
    """A drive over CAN that is under way."""

    car: SoftwareCarProcess
    loop: Loop
    out: Path
    actuator_pid: int
    stalls: Stalls

    def wait_driven(self) -> None:
        """Wait until it drives at speed; a stop before is a fault, unless the host stalled."""

        def is_driven() -> bool:
            status = self.loop.server.latest().get("status", {})
            braked_ns = self.car.braked_ns()
            if braked_ns is not None or status.get("safety") == "safe_stop":
                raise self.stopped_wrongly(status, braked_ns)
            return bool(status.get("speed_mps", 0.0) >= DRIVEN_MPS)

        wait_until("the vehicle is driven", is_driven, 90)

    def stopped_wrongly(self, status: dict[str, Any], braked_ns: int | None) -> Exception:
        """Return what to raise where it stopped though nothing was broken."""
        now_ns = CLOCK.now().mono_ns
        since_ns = self.car.event_ns("enabled", "enabled: ") or now_ns
        said = f"stopped before it drove: {status}, {self.car.events}"
        if braked_ns is not None:
            failure = self.car.unexpected_release(braked_ns, said)
        else:
            least_ms = least_stop_ms(str(status["reason"]))
            failure = self.stalls.verdict(said, since_ns, now_ns, stall_ms=least_ms)
        return or_too_slow(failure, self.stalls, since_ns, now_ns)

    def reason(self) -> str:
        """Tell why the server stopped."""
        return str(self.loop.server.latest()["status"]["reason"])

    def wait_stopped(self) -> None:
        """Wait until the server says that it has stopped for safety."""

        def is_stopped() -> bool:
            return bool(self.loop.server.latest().get("status", {}).get("safety") == "safe_stop")

        wait_until("the server has stopped for safety", is_stopped, 20)


@dataclass
class Lab:
    """Both machines, and where files go."""

    server: Machine
    client: Machine
    proofs: Path
    work: Path
    stalls: Stalls

    @contextmanager
    def driving(self, profile: str) -> Iterator[Driven]:
        """Drive a software car at speed, by a server that is proved to leave it braking. The proof is made once."""
        changes = by_wire(profile, self.proofs)
        if not (self.proofs / f"{profile}.json").exists():
            prove(self.server, changes, self.stalls)
        out = self.work / "drive"
        with software_car(BY_WIRE, *sets(changes), stalls=self.stalls, stall_ms=KIT_STALL_MS) as car:
            client = ("clock.source=probe", *SMALL)
            loop = start_by_wire(self.server, self.client, out, server_changes=changes, client_changes=client)
            try:
                driven = Driven(car, loop, out, loop.server.first_line()["ready"]["actuator_pid"], self.stalls)
                driven.wait_driven()
                yield driven
            finally:
                self.server.end_all()
                self.client.end_all()


@pytest.fixture(scope="module")
def proofs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("proofs")


@pytest.fixture
def lab(server_machine: Machine, client_machine: Machine, proofs: Path, tmp_path: Path, stalls: Stalls) -> Lab:
    return Lab(server_machine, client_machine, proofs, tmp_path, stalls)


def a_port() -> closing[CanPort]:
    """Hear the bus from now on."""
    return closing(CanPort("socketcan", "vcan0", {}, clock=CLOCK))


def last_command_ns(port: CanPort) -> int:
    """Tell when the last command came of what was heard so far."""
    return max(each.arrived_ns for each in port.take(CLOCK.now().mono_ns) if each.frame.identifier in COMMANDS)


@pytest.mark.parametrize("profile", GENERATIONS)
def test_a_route_is_driven_over_can(profile: str, lab: Lab, tell: Tell) -> None:
    """Route A key at L0 over real SocketCAN, and how long a command takes to the wheel is in the record."""
    with lab.driving(profile) as driven:
        since_ns = CLOCK.now().mono_ns
        wait_for_the_end(driven.loop, lambda _: None)
        drive = collect(driven.loop, lab.client, driven.out)
        braked_ns = driven.car.braked_ns()
    told = f"{profile}: {in_short(drive.result)}; {'; '.join(changes_of_safety(drive))}"
    tell(told)
    if drive.result["ending"] != "completed" and braked_ns is not None:
        raise or_too_slow(driven.car.unexpected_release(braked_ns, told), lab.stalls, since_ns, braked_ns)
    require_completed(drive, lab.stalls)
    require_valid(drive, lab.stalls)
    assert drive.result["p95_m"] <= P95_M
    wheel = to_wheel(drive.result)
    assert wheel["n"] > 100
    assert 0 < wheel["p50"] < wheel["p95"]


def to_wheel(result: dict[str, Any]) -> dict[str, Any]:
    stages: list[dict[str, Any]] = result["stages_ms"]
    (stage,) = [stage for stage in stages if (stage["node"], stage["stage"]) == ("vehicle", "command to wheel")]
    return stage


def in_short(result: dict[str, Any]) -> str:
    if result["ending"] != "completed":
        return str(result["ending"])
    wheel, tau_v, tau_c = to_wheel(result), result["tau_v_ms"]["p50"], result["tau_c_ms"]["p50"]
    return (
        f"completed, P95 {result['p95_m']:.3f} m, command to wheel p50 {wheel['p50']:.1f}, p95 {wheel['p95']:.1f} ms "
        f"of {wheel['n']}, tau_v {tau_v:.1f}, tau_c {tau_c:.1f} ms, {result['invalid_reasons']}"
    )


def test_a_bus_that_goes_leaves_a_braking_car(lab: Lab, tell: Tell) -> None:
    """With the interface down the kit hears nothing and brakes, the server stops; nothing is obeyed once it is up."""
    with lab.driving("dataspeed_gen2") as driven:
        since_ns = CLOCK.now().mono_ns
        take_down("vcan0")
        down_ms = ms_since(CLOCK.now().mono_ns, since_ns)
        took_ms = driven.car.wait_for_watchdog_ms(since_ns, room_ms=down_ms + ROOM_MS)
        driven.wait_stopped()
        tell(f"down took {down_ms:.0f} ms, the kit brakes {took_ms:.0f} ms after its begin, {driven.reason()}")
        ip("link", "set", "vcan0", "up")
        pause(NS_PER_S)
        assert driven.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None


def test_a_kit_that_falls_silent_stops_the_drive(lab: Lab, tell: Tell) -> None:
    """A kit in bus-off brakes by its watchdog; the server, which hears no report, stops for safety and says why."""
    with lab.driving("dataspeed_gen1") as driven:
        since_ns = driven.car.execute("bus_off")
        took_ms = driven.car.wait_for_watchdog_ms(since_ns)
        driven.wait_stopped()
        tell(f"the kit brakes {took_ms:.0f} ms after, {driven.reason()}")
        driven.car.execute("bus_on")
        pause(NS_PER_S)
        assert driven.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None


def test_no_frame_leaves_a_frozen_actuator(lab: Lab, tell: Tell) -> None:
    """Of a process that stands still the kernel sends nothing either, and thawed it sends nothing of before."""
    with lab.driving("dataspeed_gen2") as driven, a_port() as port:
        pause(2 * KIT_MS * NS_PER_MS)  # a driven kit has been commanded, and that was heard
        since_ns = CLOCK.now().mono_ns
        os.kill(driven.actuator_pid, signal.SIGSTOP)
        frozen_ns = CLOCK.now().mono_ns
        try:
            took_ms = driven.car.wait_for_watchdog_ms(since_ns)
            pause(NS_PER_S)
            last_ns = last_command_ns(port)
        finally:
            os.kill(driven.actuator_pid, signal.SIGCONT)
        driven.wait_stopped()
        pause(NS_PER_S)
        tell(f"last command {ms_since(last_ns, since_ns):.0f} ms, the kit brakes {took_ms:.0f} ms after")
        assert last_ns < frozen_ns + SENT_LATE_MS * NS_PER_MS
        assert driven.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None


def test_a_server_that_is_killed_parks_the_car(lab: Lab, tell: Tell) -> None:
    """With the server's process killed the actuator's stops the car, parks it and lets go."""
    with lab.driving("dataspeed_gen1") as driven:
        since_ns = CLOCK.now().mono_ns
        lab.server.call(processes.send_signal, driven.loop.server.number, signal.SIGKILL)
        took_ms = driven.car.wait_for_park_ms(since_ns)
        tell(f"in park {took_ms:.0f} ms after")
        assert took_ms < PARKED_MS
