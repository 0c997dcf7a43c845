"""`lavt server` drives a software car over the kernel's own CAN, with the client on another machine.

Server, actuator and software car run on the vehicle's machine, which has one processor; router and client run on the
other machine.
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
    KIT_TIMEOUT_MS,
    TOLERANCE_MS,
    SoftwareCarProcess,
    depends_on_timing,
    ms_since,
    software_car,
)
from tests.kernel.lane import processes
from tests.kernel.lane.driving import BY_WIRE, LoopPrograms, collect, start_by_wire, wait_for_end
from tests.kernel.lane.machine import Machine, MachineError, wait_until
from tests.kernel.lane.processor_use import ProcessorUse, measured_processor
from tests.kernel.lane.verdicts import (
    KIT_STALL_MS,
    entered_ns,
    explain_state,
    require_valid,
    safety_changes,
    shortest_stall_ms,
)
from tests.support.stalls import HostStalled, Stalls, excuse_slow_machine

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.dbw.bus import CanPort

UNEXPLAINED_RERUNS = 5
pytestmark = [
    pytest.mark.timeout(900),
    pytest.mark.usefixtures("vcan"),
    pytest.mark.flaky(reruns=UNEXPLAINED_RERUNS, rerun_except="^(?!HostStalled:|UnexplainedStop:)"),
]
"""A drive that stops early, or is degraded and leaves the middle of its lane, is repeated: the first machine's only
processor is barely fast enough for three programs. A fault that stops every drive, or most of them, fails the tests."""

ReportMeasurement = Callable[[str], None]

SMALL_PICTURES = ("camera.width_px=320", "camera.height_px=240", "camera.rate_hz=10")
"""Pictures that a user-mode kernel, with one processor and slow system calls, can process in time."""
MAX_P95_M = 0.22
COMMAND_IDENTIFIERS = {0x200, 0x201, 0x202}
"""Steering, brake and throttle in generation 2's set `remote`."""
LATE_FRAME_MS = 20
"""A frame that was sent before the process was frozen is allowed to arrive this much later."""
SIOCSIFFLAGS = 0x8914
"""linux/sockios.h"""
PARKING_LIMIT_MS = 6000
DRIVING_MPS = 5.0
CLOCK = MachineClock()


@pytest.fixture
def vcan() -> Iterator[None]:
    """Create the interface that the config names, and delete it afterwards."""
    ip("link", "add", "vcan0", "type", "vcan")
    ip("link", "set", "vcan0", "up")
    yield
    subprocess.run(["ip", "link", "delete", "vcan0"], check=False)


def set_interface_down(interface: str) -> None:
    """Set an interface down without starting a program, which would block a user-mode kernel."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sh14x", interface.encode(), 0))


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


def by_wire_changes(profile: str, work: Path) -> tuple[str, ...]:
    """Return the changes of the server's config, which the software car gets, too."""
    return (
        f"vehicle.dbw.profile={profile}",
        "vehicle.dbw.steering_sign=1",
        f"vehicle.dbw.watchdog_proof={work / f'{profile}.json'}",
        "clock.source=probe",
        "video.bit_rate_bps=1000000",
        "record.video=false",
        *SMALL_PICTURES,
    )


def set_arguments(changes: tuple[str, ...]) -> list[str]:
    return [part for change in changes for part in ("--set", change)]


def run_watchdog_test(machine: Machine, changes: tuple[str, ...], stalls: Stalls) -> None:
    """Run `lavt can test-watchdog`, which tests that the kit's watchdog brakes."""
    with software_car(BY_WIRE, *set_arguments(changes)) as car:
        since_ns = CLOCK.now().mono_ns
        try:
            machine.run(
                [machine.python, "-B", "-m", "lavt", "can", "test-watchdog", BY_WIRE, *set_arguments(changes), "--yes"]
            )
        except MachineError as failure:
            message = f"{failure}, {car.events}"
            assert depends_on_timing(message), message
            raise stalls.verdict(message, since_ns, CLOCK.now().mono_ns, stall_ms=KIT_STALL_MS) from None


class UnexplainedStop(Exception):
    """A drive stopped early for a time-out that no recorded stall explains."""


def explain(failure: Exception, processor: ProcessorUse, stopped_ns: int) -> Exception:
    """Return the exception for a drive that stopped early: `HostStalled` if a record explains the stop."""
    failure = processor.verdict(failure, stopped_ns)
    return failure if isinstance(failure, HostStalled) else UnexplainedStop(str(failure))


@dataclass
class ActiveDrive:
    """A drive over CAN in progress."""

    car: SoftwareCarProcess
    loop: LoopPrograms
    out: Path
    actuator_pid: int
    stalls: Stalls
    processor: ProcessorUse

    def wait_until_driving(self) -> None:
        """Wait until the vehicle drives at speed; an earlier stop is a fault, unless the host stalled."""

        def is_driving() -> bool:
            status = self.loop.server.latest().get("status", {})
            braked_ns = self.car.watchdog_braked_ns()
            if braked_ns is not None or status.get("safety") == "safe_stop":
                raise self.explain_stop(status, braked_ns)
            return bool(status.get("speed_mps", 0.0) >= DRIVING_MPS)

        wait_until("the vehicle drives at speed", is_driving, 90)

    def explain_stop(self, status: dict[str, Any], braked_ns: int | None) -> Exception:
        """Return the exception for a stop that no test caused."""
        now_ns = CLOCK.now().mono_ns
        since_ns = self.car.event_ns("enabled", "enabled: ") or now_ns
        message = f"stopped before it drove: {status}, {self.car.events}"
        if braked_ns is not None:
            return self.car.unexpected_release(braked_ns, message)
        stall_ms = shortest_stall_ms(str(status["reason"]))
        failure = self.stalls.verdict(message, since_ns, now_ns, stall_ms=stall_ms)
        return explain(excuse_slow_machine(failure, self.stalls, since_ns, now_ns), self.processor, now_ns)

    def reason(self) -> str:
        """Return the server's reason for the stop."""
        return str(self.loop.server.latest()["status"]["reason"])

    def wait_until_stopped(self) -> None:
        """Wait until the server reports a safe stop."""

        def is_stopped() -> bool:
            return bool(self.loop.server.latest().get("status", {}).get("safety") == "safe_stop")

        wait_until("the server has stopped for safety", is_stopped, 20)


@dataclass
class CanLab:
    """Both machines and the directories for files."""

    server: Machine
    client: Machine
    proof_folder: Path
    work: Path
    stalls: Stalls

    @contextmanager
    def driving(self, profile: str) -> Iterator[ActiveDrive]:
        """Drive a software car at speed; the watchdog test runs first, once per profile."""
        changes = by_wire_changes(profile, self.proof_folder)
        if not (self.proof_folder / f"{profile}.json").exists():
            run_watchdog_test(self.server, changes, self.stalls)
        out = self.work / "drive"
        with (
            measured_processor() as processor,
            software_car(
                BY_WIRE,
                *set_arguments(changes),
                stalls=self.stalls,
                stall_ms=KIT_STALL_MS,
                explain=lambda failure, stopped_ns: explain(failure, processor, stopped_ns),
            ) as car,
        ):
            client = ("clock.source=probe", *SMALL_PICTURES)
            loop = start_by_wire(self.server, self.client, out, server_changes=changes, client_changes=client)
            try:
                active_drive = ActiveDrive(
                    car, loop, out, loop.server.first_line()["ready"]["actuator_pid"], self.stalls, processor
                )
                active_drive.wait_until_driving()
                yield active_drive
            finally:
                self.server.stop_all()
                self.client.stop_all()


@pytest.fixture(scope="module")
def proof_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("proofs")


@pytest.fixture
def lab(server_machine: Machine, client_machine: Machine, proof_folder: Path, tmp_path: Path, stalls: Stalls) -> CanLab:
    return CanLab(server_machine, client_machine, proof_folder, tmp_path, stalls)


def open_port() -> closing[CanPort]:
    """Open a port that receives the bus from now on."""
    return closing(CanPort("socketcan", "vcan0", {}, clock=CLOCK))


def last_command_ns(port: CanPort) -> int:
    """Return when the last command so far was received."""
    return max(
        received.arrived_ns
        for received in port.take(CLOCK.now().mono_ns)
        if received.frame.identifier in COMMAND_IDENTIFIERS
    )


@pytest.mark.parametrize("profile", GENERATIONS)
def test_drive_over_can_completes(profile: str, lab: CanLab, report_measurement: ReportMeasurement) -> None:
    """Route A key at L0 is completed over SocketCAN, and the record has the times from command to wheel."""
    with lab.driving(profile) as active_drive:
        since_ns = CLOCK.now().mono_ns
        wait_for_end(active_drive.loop, lambda _: None)
        drive = collect(active_drive.loop, lab.client, active_drive.out)
        braked_ns = active_drive.car.watchdog_braked_ns()
    measurements = f"{profile}: {describe_result(drive.result)}; {'; '.join(safety_changes(drive))}"
    report_measurement(measurements)
    if braked_ns is not None:
        raise active_drive.car.unexpected_release(braked_ns, measurements)
    is_completed = drive.result["ending"] == "completed"
    late_ns = entered_ns(drive, state := "degraded" if is_completed else "safe_stop")
    if late_ns is not None and not (is_completed and drive.result["p95_m"] <= MAX_P95_M):
        failure = explain_state(drive, lab.stalls, state, measurements)
        failure = excuse_slow_machine(failure, lab.stalls, since_ns, late_ns)
        raise explain(failure, active_drive.processor, late_ns)
    assert is_completed, measurements
    require_valid(drive, lab.stalls)
    assert drive.result["p95_m"] <= MAX_P95_M
    wheel = command_to_wheel_stage(drive.result)
    assert wheel["n"] > 100
    assert 0 < wheel["p50"] < wheel["p95"]


def command_to_wheel_stage(result: dict[str, Any]) -> dict[str, Any]:
    stages: list[dict[str, Any]] = result["stages_ms"]
    (stage,) = [stage for stage in stages if (stage["node"], stage["stage"]) == ("vehicle", "command to wheel")]
    return stage


def describe_result(result: dict[str, Any]) -> str:
    if result["ending"] != "completed":
        return str(result["ending"])
    wheel, tau_v, tau_c = command_to_wheel_stage(result), result["tau_v_ms"]["p50"], result["tau_c_ms"]["p50"]
    return (
        f"completed, P95 {result['p95_m']:.3f} m, command to wheel p50 {wheel['p50']:.1f}, p95 {wheel['p95']:.1f} ms "
        f"of {wheel['n']}, tau_v {tau_v:.1f}, tau_c {tau_c:.1f} ms, {result['invalid_reasons']}"
    )


def test_lost_bus_stops_the_car(lab: CanLab, report_measurement: ReportMeasurement) -> None:
    """If the interface goes down, kit and server stop the car; when it is up again, the kit stays disengaged."""
    with lab.driving("dataspeed_gen2") as active_drive:
        since_ns = CLOCK.now().mono_ns
        set_interface_down("vcan0")
        down_ms = ms_since(CLOCK.now().mono_ns, since_ns)
        took_ms = active_drive.car.wait_for_watchdog_ms(since_ns, tolerance_ms=down_ms + TOLERANCE_MS)
        active_drive.wait_until_stopped()
        report_measurement(f"the interface was down after {down_ms:.0f} ms, the kit brakes after {took_ms:.0f} ms")
        report_measurement(active_drive.reason())
        ip("link", "set", "vcan0", "up")
        pause(NS_PER_S)
        assert active_drive.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None


def test_silent_kit_stops_the_drive(lab: CanLab, report_measurement: ReportMeasurement) -> None:
    """A kit in bus-off brakes by its watchdog, and the server makes a safe stop; then the kit stays disengaged."""
    with lab.driving("dataspeed_gen1") as active_drive:
        since_ns = active_drive.car.execute("bus_off")
        took_ms = active_drive.car.wait_for_watchdog_ms(since_ns)
        active_drive.wait_until_stopped()
        report_measurement(f"the kit brakes after {took_ms:.0f} ms, {active_drive.reason()}")
        active_drive.car.execute("bus_on")
        pause(NS_PER_S)
        assert active_drive.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None


def test_frozen_actuator_sends_no_frames(lab: CanLab, report_measurement: ReportMeasurement) -> None:
    """A frozen actuator process sends no frames, and the kit stays disengaged after the process is resumed."""
    with lab.driving("dataspeed_gen2") as active_drive, open_port() as port:
        pause(2 * KIT_TIMEOUT_MS * NS_PER_MS)  # by then the kit gets commands, and the port receives them
        since_ns = CLOCK.now().mono_ns
        os.kill(active_drive.actuator_pid, signal.SIGSTOP)
        frozen_ns = CLOCK.now().mono_ns
        try:
            took_ms = active_drive.car.wait_for_watchdog_ms(since_ns)
            pause(NS_PER_S)
            last_ns = last_command_ns(port)
        finally:
            os.kill(active_drive.actuator_pid, signal.SIGCONT)
        pause(2 * NS_PER_S)  # the server has ended by then, because it got no state from the actuator for 0.5 s
        report_measurement(f"last command {ms_since(last_ns, since_ns):.0f} ms, the kit brakes after {took_ms:.0f} ms")
        assert last_ns < frozen_ns + LATE_FRAME_MS * NS_PER_MS
        assert active_drive.car.event_ns("enabled", "enabled: ", since_ns=since_ns) is None


def test_killed_server_leaves_a_parked_car(lab: CanLab, report_measurement: ReportMeasurement) -> None:
    """After the server's process is killed, the actuator's process stops the car, parks it and disengages."""
    with lab.driving("dataspeed_gen1") as active_drive:
        since_ns = CLOCK.now().mono_ns
        lab.server.call(processes.send_signal, active_drive.loop.server.number, signal.SIGKILL)
        took_ms = active_drive.car.wait_for_park_ms(since_ns)
        report_measurement(f"in park after {took_ms:.0f} ms")
        assert took_ms < PARKING_LIMIT_MS
