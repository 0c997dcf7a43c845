"""Test `lavt software-car` in a process of its own, on a `udp_multicast` bus of python-can."""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from tests.support.command_line import Run
from tests.support.ports import free_port
from tests.vehicle.software_car.rig import CommandValues, Sender1, Sender2

from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.can_frame import CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw.bus import CanPort
from lavt.vehicle.ground_truth_wire import MAX_BYTES, TruthReceiver
from lavt.vehicle.software_car.frames import unpack
from lavt.vehicle.software_car.generation_1 import STEERING_REPORT
from lavt.vehicle.software_car.generation_2_layouts import REPORT_LAYOUTS

SERVER = str(shipped("configs/server.yaml"))
MULTICAST_GROUP = "239.74.163.2"
TIMEOUT_S = 20


class SoftwareCarProgram:
    """A `lavt software-car` process on a bus of its own, and this process's port on that bus."""

    def __init__(self, *changes: str, as_json: bool = True) -> None:
        bus = ["vehicle.dbw.interface=udp_multicast", f"vehicle.dbw.channel={MULTICAST_GROUP}"]
        port = free_port()
        options = [f"vehicle.dbw.options={{port: {port}}}"]
        arguments = [part for change in (*bus, *options, *changes) for part in ("--set", change)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "lavt", "software-car", SERVER, *arguments, *(["--json"] if as_json else [])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        self.port = CanPort("udp_multicast", MULTICAST_GROUP, {"port": port}, clock=MachineClock())

    def read_line(self) -> str:
        """Read the next printed line."""
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def read_json(self) -> dict[str, Any]:
        """Read the next printed line as JSON."""
        line = self.read_line()
        assert line, self.process.communicate()
        value: dict[str, Any] = json.loads(line)
        return value

    def wait_for(self, kind: str) -> dict[str, Any]:
        """Skip events until one of this kind; return it."""
        while (event := self.read_json()).get("kind") != kind:
            pass
        return event

    def type(self, line: str) -> None:
        """Write a line to the standard input of the process."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")

    def send(self, *frames: CanFrame) -> None:
        """Send frames on the bus."""
        self.port.send(frames, MachineClock().now().mono_ns)

    def receive(self, is_done: Callable[[list[ReceivedCanFrame]], object]) -> list[ReceivedCanFrame]:
        """Receive frames until `is_done` returns a true value for all of them; return the frames."""
        received: list[ReceivedCanFrame] = []
        clock = MachineClock()
        end_ns = clock.now().mono_ns + TIMEOUT_S * NS_PER_S
        while not is_done(received):
            assert clock.now().mono_ns < end_ns, received[-10:]
            received += self.port.take(clock.now().mono_ns)
            pause(NS_PER_MS)
        return received

    def end(self, signal_number: signal.Signals = signal.SIGINT) -> tuple[str, str]:
        """End the process by a signal; return the rest of its output."""
        self.process.send_signal(signal_number)
        out, err = self.process.communicate(timeout=TIMEOUT_S)
        return out, err


Start = Callable[..., SoftwareCarProgram]


@pytest.fixture
def start() -> Iterator[Start]:
    """Return a function that starts programs, which are killed at the end of the test."""
    programs: list[SoftwareCarProgram] = []

    def start_one(*changes: str, as_json: bool = True) -> SoftwareCarProgram:
        programs.append(SoftwareCarProgram(*changes, as_json=as_json))
        return programs[-1]

    yield start_one
    for program in programs:
        program.port.close()
        if program.process.poll() is None:
            program.process.kill()
        program.process.communicate()


@pytest.mark.realtime
@pytest.mark.judges_times
def test_reports_and_ground_truth(start: Start) -> None:
    """The car sends the kit's reports at their periods and its true position, and exits with 0 on Ctrl-C."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(TIMEOUT_S)
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        program = start(f"vehicle.dbw.truth={address}")
        ready = program.read_json()["ready"]
        assert ready == {
            "generation": 2,
            "commands": "remote",
            "interface": "udp_multicast",
            "channel": MULTICAST_GROUP,
            "truth": address,
        }
        program.receive(bool)
        received = program.receive(lambda frames: len(frames) >= 760)
        receiver, before_ns = TruthReceiver(), MachineClock().now().mono_ns
        while receiver.newest is None or receiver.newest.mono_ns < before_ns:
            receiver.receive(listener.recv(MAX_BYTES))
    assert receiver.newest.speed_mps == 0.0
    assert receiver.newest.progress_m > 0.0
    for identifier, period_ms in ((0x100, 10), (0x101, 20), (0x103, 100)):
        arrived_ns = [report.arrived_ns for report in received if report.frame.identifier == identifier]
        gaps_ms = [(after - before) / NS_PER_MS for before, after in itertools.pairwise(arrived_ns)]
        assert statistics.median(gaps_ms) == pytest.approx(period_ms, abs=0.2 * period_ms)
    out, err = program.end()
    (last_line,) = [json.loads(line) for line in out.splitlines()]
    assert last_line["counts"]["frames_sent"] >= 760
    assert last_line["counts"]["frames_heard"] == last_line["counts"]["frames_lost"] == 0
    assert (program.process.returncode, err) == (0, "")


@pytest.mark.realtime
@pytest.mark.parametrize(("profile", "identifier"), [("dataspeed_gen1", 0x065), ("dataspeed_gen2", 0x100)])
def test_a_fault_changes_the_reports(profile: str, identifier: int, start: Start) -> None:
    """A fault set on standard input is in the kit's reports until it is cleared."""
    layout, fault = (STEERING_REPORT, "FLTPWR") if identifier == 0x065 else (REPORT_LAYOUTS[0x100], "fault")
    program = start(f"vehicle.dbw.profile={profile}")
    program.read_json()

    def is_reported(is_set: int) -> Callable[[list[ReceivedCanFrame]], object]:
        def is_in_last_report(received: list[ReceivedCanFrame]) -> bool:
            frames = [report.frame for report in received if report.frame.identifier == identifier]
            return bool(frames) and unpack(layout, frames[-1].data)[fault] == is_set

        return is_in_last_report

    program.receive(is_reported(0))
    program.type(f"fault steering.{fault}")
    assert program.wait_for("done")["text"] == f"fault steering.{fault}"
    program.receive(is_reported(1))
    program.type(f"clear_fault steering.{fault}")
    program.wait_for("done")
    program.receive(is_reported(0))
    program.type("clear_fault the wheel")
    assert "'the wheel'" in program.wait_for("rejected")["text"]


@pytest.mark.realtime
@pytest.mark.judges_times
@pytest.mark.parametrize("generation", [1, 2])
def test_driven_by_another_process(generation: int, start: Start) -> None:
    """The car executes commands of another process, reports its events, and brakes when the commands stop."""
    program = start(f"vehicle.dbw.profile=dataspeed_gen{generation}")
    program.read_json()
    sender: Sender1 | Sender2 = Sender1() if generation == 1 else Sender2()
    braking_commands, all_commands = 25, 125
    for index in range(all_commands):
        values = CommandValues(brake=0.5) if index < braking_commands else CommandValues(throttle=0.4)
        program.send(*sender.commands(values))
        if index in {10, 12} and isinstance(sender, Sender2):
            program.send(sender.system(1))
        if index == 20:
            program.send(sender.gear(4))  # DRIVE
        pause(20 * NS_PER_MS)
    enabled = program.wait_for("enabled")
    while not enabled["text"].endswith(": steering, brake, throttle"):  # generation 1 enables one axis after another
        enabled = program.wait_for("enabled")
    assert "DRIVE" in program.wait_for("gear")["text"]
    assert "no command" in program.wait_for("enabled")["text"]
    assert "no command" in program.wait_for("watchdog")["text"]
    speeds_mps = [  # reported in 0.01 km/h
        int.from_bytes(report.frame.data[4:6] if generation == 1 else report.frame.data[:2], "little", signed=True)
        / 360
        for report in program.port.take(0)
        if report.frame.identifier == (0x065 if generation == 1 else 0x107)
    ]
    assert max(speeds_mps) > 0.5


@pytest.mark.realtime
def test_output_as_text(start: Start) -> None:
    """Without `--json` the car prints its bus, and each event with the time since the start."""
    program = start(as_json=False)
    assert f"udp_multicast {MULTICAST_GROUP}" in program.read_line()
    program.type("driver_shifts DRIVE")
    assert program.read_line().endswith(" s  driver_shifts DRIVE\n")
    time_s, _, text = program.read_line().partition(" s  ")
    assert float(time_s) > 0.0
    assert "DRIVE" in text
    program.type("help")
    assert program.read_line().startswith("driver_steers NM ")


@pytest.mark.realtime
def test_closed_standard_input(start: Start) -> None:
    """The car keeps running after standard input is closed, and after incomplete lines and bytes that are not text."""
    program = start()
    program.read_json()
    assert program.process.stdin is not None
    os.write(program.process.stdin.fileno(), b"\xff\xfe\n" + b"x" * 5000 + b"\nbus_")
    assert [program.read_json()["kind"] for _ in range(2)] == ["rejected", "rejected"]
    program.process.stdin.close()
    program.process.stdin = None
    program.port.take(0)
    program.receive(lambda received: len(received) > 200)
    _, err = program.end(signal.SIGTERM)
    assert (program.process.returncode, err) == (0, "")


BAD_SETTINGS = {
    "inside": (["interface=inside"], "vehicle.dbw.interface"),
    "unknown profile": (["profile=bicycle"], "'bicycle'"),
    "invalid address": (["truth=here"], "vehicle.dbw.truth: 'here'"),
    "unknown interface": (["interface=pigeon"], "pigeon"),
    "unknown channel": (["interface=udp_multicast", "channel=nowhere"], "udp_multicast nowhere"),
    "unknown key": (["chanel=can1"], "'vehicle.dbw.chanel'"),
}


@pytest.mark.parametrize("case", BAD_SETTINGS)
def test_bad_input(case: str, run: Run) -> None:
    """An invalid setting of the bus is rejected in one sentence with exit code 2."""
    changes, reason = BAD_SETTINGS[case]
    arguments = [part for change in changes for part in ("--set", f"vehicle.dbw.{change}")]
    assert reason in run("software-car", SERVER, *arguments).rejection()


@pytest.mark.parametrize(("change", "reason"), [("route=nowhere", "'nowhere'"), ("car=bike", "'bike'")])
def test_unknown_road_or_car(change: str, reason: str, run: Run) -> None:
    """An unknown road or car is rejected before the bus, which does not exist here, is opened."""
    assert reason in run("software-car", SERVER, "--set", f"vehicle.{change}").rejection()
