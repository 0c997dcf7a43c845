"""The software car as a program of its own, on a bus of python-can's `udp_multicast`."""

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
GROUP = "239.74.163.2"
LONGEST_S = 20


class Program:
    """`lavt software-car` in a process of its own, on a bus of its own, and this process at the bus's other end."""

    def __init__(self, *changes: str, as_json: bool = True) -> None:
        bus = ["vehicle.dbw.interface=udp_multicast", f"vehicle.dbw.channel={GROUP}"]
        port = free_port()
        options = [f"vehicle.dbw.options={{port: {port}}}"]
        arguments = [part for change in (*bus, *options, *changes) for part in ("--set", change)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "lavt", "software-car", SERVER, *arguments, *(["--json"] if as_json else [])],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1,
        )  # fmt: skip
        self.port = CanPort("udp_multicast", GROUP, {"port": port}, clock=MachineClock())

    def line(self) -> str:
        """The next line that it prints."""
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def told(self) -> dict[str, Any]:
        """The next line that it prints, of JSON."""
        line = self.line()
        assert line, self.process.communicate()
        told: dict[str, Any] = json.loads(line)
        return told

    def until(self, kind: str) -> dict[str, Any]:
        """The next news of a kind."""
        while (told := self.told()).get("kind") != kind:
            pass
        return told

    def type(self, line: str) -> None:
        """Type a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")

    def send(self, *frames: CanFrame) -> None:
        """Put frames on the bus."""
        self.port.send(frames, MachineClock().now().mono_ns)

    def hear(self, done: Callable[[list[ReceivedCanFrame]], object]) -> list[ReceivedCanFrame]:
        """Hear frames until it is done."""
        heard: list[ReceivedCanFrame] = []
        clock = MachineClock()
        end_ns = clock.now().mono_ns + LONGEST_S * NS_PER_S
        while not done(heard):
            assert clock.now().mono_ns < end_ns, heard[-10:]
            heard += self.port.take(clock.now().mono_ns)
            pause(NS_PER_MS)
        return heard

    def end(self, number: signal.Signals = signal.SIGINT) -> tuple[str, str]:
        """End it by a signal, and give the rest of what it prints."""
        self.process.send_signal(number)
        out, err = self.process.communicate(timeout=LONGEST_S)
        return out, err


Start = Callable[..., Program]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start programs that are ended at the latest when the test ends."""
    programs: list[Program] = []

    def start_one(*changes: str, as_json: bool = True) -> Program:
        programs.append(Program(*changes, as_json=as_json))
        return programs[-1]

    yield start_one
    for program in programs:
        program.port.close()
        if program.process.poll() is None:
            program.process.kill()
        program.process.communicate()


@pytest.mark.realtime
@pytest.mark.judges_times
def test_it_reports_and_tells_the_truth(start: Start) -> None:
    """Ready, it sends the kit's reports at their periods, tells the truth, and ends with 0 and its counts on Ctrl-C."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(LONGEST_S)
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        program = start(f"vehicle.dbw.truth={address}")
        ready = program.told()["ready"]
        assert ready == {
            "generation": 2, "commands": "remote", "interface": "udp_multicast", "channel": GROUP, "truth": address,
        }  # fmt: skip
        program.hear(bool)
        heard = program.hear(lambda heard: len(heard) >= 760)
        receiver, before_ns = TruthReceiver(), MachineClock().now().mono_ns
        while receiver.newest is None or receiver.newest.mono_ns < before_ns:
            receiver.receive(listener.recv(MAX_BYTES))
    assert receiver.newest.speed_mps == 0.0
    assert receiver.newest.progress_m > 0.0
    for identifier, period_ms in ((0x100, 10), (0x101, 20), (0x103, 100)):
        arrived = [each.arrived_ns for each in heard if each.frame.identifier == identifier]
        gaps_ms = [(after - before) / NS_PER_MS for before, after in itertools.pairwise(arrived)]
        assert statistics.median(gaps_ms) == pytest.approx(period_ms, abs=0.2 * period_ms)
    out, err = program.end()
    (end,) = [json.loads(line) for line in out.splitlines()]
    assert end["counts"]["frames_sent"] >= 760
    assert end["counts"]["frames_heard"] == end["counts"]["frames_lost"] == 0
    assert (program.process.returncode, err) == (0, "")


@pytest.mark.realtime
@pytest.mark.parametrize(("profile", "identifier"), [("dataspeed_gen1", 0x065), ("dataspeed_gen2", 0x100)])
def test_a_fault_changes_the_reports(profile: str, identifier: int, start: Start) -> None:
    """A fault typed on standard input is in the kit's reports, is told, and is gone from them once it is mended."""
    layout, fault = (STEERING_REPORT, "FLTPWR") if identifier == 0x065 else (REPORT_LAYOUTS[0x100], "fault")
    program = start(f"vehicle.dbw.profile={profile}")
    program.told()

    def is_reported(is_set: int) -> Callable[[list[ReceivedCanFrame]], object]:
        def look(heard: list[ReceivedCanFrame]) -> bool:
            frames = [each.frame for each in heard if each.frame.identifier == identifier]
            return bool(frames) and unpack(layout, frames[-1].data)[fault] == is_set

        return look

    program.hear(is_reported(0))
    program.type(f"fault steering.{fault}")
    assert program.until("done")["text"] == f"fault steering.{fault}"
    program.hear(is_reported(1))
    program.type(f"clear_fault steering.{fault}")
    program.until("done")
    program.hear(is_reported(0))
    program.type("clear_fault the wheel")
    assert "'the wheel'" in program.until("rejected")["text"]


@pytest.mark.realtime
@pytest.mark.judges_times
@pytest.mark.timeout(60)
@pytest.mark.parametrize("generation", [1, 2])
def test_it_is_driven_by_another_process(generation: int, start: Start) -> None:
    """It obeys commands of another process, tells what it does, and brakes when the commands stop."""
    program = start(f"vehicle.dbw.profile=dataspeed_gen{generation}")
    program.told()
    sender: Sender1 | Sender2 = Sender1() if generation == 1 else Sender2()
    for index in range(125):
        program.send(*sender.commands(CommandValues(brake=0.5) if index < 25 else CommandValues(throttle=0.4)))
        if index in {10, 12} and isinstance(sender, Sender2):
            program.send(sender.system(1))
        if index == 20:
            program.send(sender.gear(4))
        pause(20 * NS_PER_MS)
    accepts = program.until("enabled")
    while accepts["text"] != "enabled: steering, brake, throttle":  # generation 1: one after another
        accepts = program.until("enabled")
    assert program.until("gear")["text"] == "gear DRIVE"
    assert program.until("enabled")["text"].startswith("released: no command in time")
    assert program.until("watchdog")["text"].startswith("watchdog brakes: no command in time")
    speeds = [
        int.from_bytes(each.frame.data[4:6] if generation == 1 else each.frame.data[:2], "little", signed=True) / 360
        for each in program.port.take(0)
        if each.frame.identifier == (0x065 if generation == 1 else 0x107)
    ]
    assert max(speeds) > 0.5


@pytest.mark.realtime
def test_it_is_told_in_words(start: Start) -> None:
    """Without `--json` it says what it is, and each news with the time since the start."""
    program = start(as_json=False)
    assert f"udp_multicast {GROUP}" in program.line()
    program.type("driver_shifts DRIVE")
    assert program.line().endswith(" s  driver_shifts DRIVE\n")
    at, _, text = program.line().partition(" s  ")
    assert (float(at) > 0.0, text) == (True, "gear DRIVE\n")
    program.type("help")
    assert program.line().startswith("driver_steers NM ")


@pytest.mark.realtime
def test_words_may_end(start: Start) -> None:
    """When standard input ends the car lives on, and neither half a line nor bytes that are no text end it."""
    program = start()
    program.told()
    assert program.process.stdin is not None
    os.write(program.process.stdin.fileno(), b"\xff\xfe\n" + b"x" * 5000 + b"\nbus_")
    assert [program.told()["kind"] for _ in range(2)] == ["rejected", "rejected"]
    program.process.stdin.close()
    program.process.stdin = None
    program.port.take(0)
    program.hear(lambda heard: len(heard) > 200)
    _, err = program.end(signal.SIGTERM)
    assert (program.process.returncode, err) == (0, "")


BAD = {
    "inside": (["interface=inside"], "vehicle.dbw.interface"),
    "no such profile": (["profile=bicycle"], "'bicycle'"),
    "no address": (["truth=here"], "vehicle.dbw.truth: 'here'"),
    "no such interface": (["interface=pigeon"], "pigeon"),
    "no such channel": (["interface=udp_multicast", "channel=nowhere"], "udp_multicast nowhere"),
    "unknown key": (["chanel=can1"], "'vehicle.dbw.chanel'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case: str, run: Run) -> None:
    """What cannot be is refused in one sentence, with exit code 2 and nothing on standard output."""
    changes, said = BAD[case]
    arguments = [part for change in changes for part in ("--set", f"vehicle.dbw.{change}")]
    assert said in run("software-car", SERVER, *arguments).rejected()


@pytest.mark.parametrize(("change", "said"), [("route=nowhere", "'nowhere'"), ("car=bike", "'bike'")])
def test_a_car_that_is_not_there(change: str, said: str, run: Run) -> None:
    """A road or a car that does not exist is refused, before the bus is opened: there is none."""
    assert said in run("software-car", SERVER, "--set", f"vehicle.{change}").rejected()
