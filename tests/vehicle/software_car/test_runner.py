"""The loop that runs a software car, with times chosen by the tests."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from tests.vehicle.software_car.rig import START_NS, CommandValues, Sender2, with_crc_broken
from tests.vehicle.software_car.test_in_process_bus import port_of

from lavt.domain import NS_PER_MS, NS_PER_S, VehicleEvent
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame
from lavt.vehicle.ground_truth_wire import TruthReceiver
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.runner import SoftwareCarRunner
from lavt.vehicle.software_car.state import Gear

STEP_NS = NS_PER_S // 240 + 1


class Bus:
    """A port whose other end is the test."""

    def __init__(self) -> None:
        self.sent: list[tuple[CanFrame, int]] = []
        self.incoming: list[ReceivedCanFrame] = []
        self.gone_reason = ""
        self.counts: dict[str, int] = {}

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> int:
        """Record frames."""
        if self.gone_reason:
            raise BusGone(self.gone_reason)
        self.sent += [(frame, made_ns) for frame in frames]
        return len(frames)

    def take(self, _now_ns: int) -> list[ReceivedCanFrame]:
        """Return the incoming frames."""
        if self.gone_reason:
            raise BusGone(self.gone_reason)
        taken, self.incoming = self.incoming, []
        return taken

    def next_wake_ns(self) -> None:
        """Return None: not known."""

    def close(self) -> None:
        """Do nothing."""


class RunnerRig:
    """A runner with its bus, a sender of commands, and a clock."""

    def __init__(self) -> None:
        self.bus, self.sender = Bus(), Sender2()
        self.car: SoftwareCar = port_of(2).car
        self.runner = SoftwareCarRunner(self.car, self.bus, start_ns=START_NS)
        self.now_ns = START_NS
        self.events: list[tuple[str, str]] = []

    def deliver(self, *frames: CanFrame, at_ns: int | None = None) -> None:
        """Deliver frames from the bus."""
        self.bus.incoming += [ReceivedCanFrame(frame, self.now_ns if at_ns is None else at_ns) for frame in frames]

    def step_ms(self, passed_ms: float = 0) -> None:
        """Let time pass, then call `step` once."""
        self.now_ns += round(passed_ms * NS_PER_MS)
        self.runner.step(self.now_ns)
        self.collect_events()

    def collect_events(self) -> list[tuple[str, str]]:
        """Record and return the new events."""
        events = [(event.kind, event.text) for event in self.runner.take_events()]
        self.events += events
        return events

    def enable(self) -> None:
        """Enable the kit and shift into drive."""
        self.deliver(*self.sender.commands(CommandValues(brake=0.5)), self.sender.system(1), self.sender.gear(4))
        self.step_ms()

    def drive_ms(self, duration_ms: int, **keys: float) -> None:
        """Send commands every 20 ms."""
        for _ in range(duration_ms // 20):
            self.deliver(*self.sender.commands(CommandValues(**keys)))  # type: ignore[arg-type]
            self.step_ms(20)


def test_reports_have_the_times_at_which_they_were_due() -> None:
    """However late a step is, each frame is sent with the time at which the frame was due."""
    rig = RunnerRig()
    rig.step_ms(35)
    due = [(frame.identifier, (made_ns - START_NS) / NS_PER_MS) for frame, made_ns in rig.bus.sent]
    fast, slow = (0x100, 0x2A4), (0x100, 0x101, 0x102, 0x107, 0x2A4)
    assert due == [
        *((identifier, 10) for identifier in fast),
        *((identifier, 20) for identifier in slow),
        *((identifier, 30) for identifier in fast),
    ]


def test_the_car_catches_up() -> None:
    """After a delay of 0.3 s the car has taken all its steps, and a timeout has the time at which it was due."""
    rig = RunnerRig()
    rig.enable()
    rig.drive_ms(1_000, throttle=0.3)
    wake_ns = rig.runner.next_wake_ns()
    rig.now_ns += 300 * NS_PER_MS
    rig.runner.step(rig.now_ns)
    events = rig.runner.take_events()
    assert rig.now_ns - rig.car.simulator.state().mono_ns <= STEP_NS
    (watchdog,) = [event for event in events if event.kind == "watchdog"]
    assert watchdog.text.startswith("watchdog brakes: ")
    # The timeout of 100 ms began with the last command, 20 ms before the delay of 300 ms.
    assert watchdog.mono_ns == rig.now_ns - 220 * NS_PER_MS
    assert rig.runner.max_delay_ns == rig.now_ns - wake_ns


def test_frames_are_processed_at_their_arrival_times() -> None:
    """A command is processed at its arrival time, not at the time of the step."""
    rig = RunnerRig()
    rig.step_ms(20)
    rig.deliver(*rig.sender.commands(CommandValues(brake=0.5)), at_ns=rig.now_ns + 5 * NS_PER_MS)
    rig.step_ms(20)
    assert rig.car.kit.state.actuators["brake"].received_ns == START_NS + 25 * NS_PER_MS
    assert rig.runner.counts["frames_heard"] == 3


@pytest.mark.parametrize(("at_ms", "taken_ms"), [(-1000, 20), (1000, 40)])
def test_invalid_arrival_times(at_ms: int, taken_ms: int) -> None:
    """An arrival time before the previous step or after the current step is clamped to the nearer of these steps."""
    rig = RunnerRig()
    rig.step_ms(20)
    rig.deliver(*rig.sender.commands(CommandValues(brake=0.5)), at_ns=START_NS + at_ms * NS_PER_MS)
    rig.step_ms(20)
    assert rig.car.kit.state.actuators["brake"].received_ns == START_NS + taken_ms * NS_PER_MS


def test_events_of_a_drive() -> None:
    """Each change is an event, once and in order: enabling, the gear, an override, disengaging, clearing."""
    rig = RunnerRig()
    rig.enable()
    rig.drive_ms(200, throttle=0.3)
    rig.runner.execute("driver_steers 3", rig.now_ns)
    rig.collect_events()
    rig.drive_ms(100, throttle=0.3)
    rig.runner.execute("driver_steers 0", rig.now_ns)
    rig.deliver(*rig.sender.clearing())
    rig.step_ms(1)
    assert rig.events == [
        ("enabled", "enabled: steering, brake, throttle"),
        ("gear", "gear DRIVE"),
        ("done", "driver_steers 3"),
        ("enabled", "released: override by the driver"),
        ("overridden", "override by the driver: steering"),
        ("readiness", "not ready: override by the driver"),
        ("done", "driver_steers 0"),
        ("overridden", "override cleared"),
        ("readiness", "ready"),
    ]


def test_events_of_the_watchdog() -> None:
    """A wrong checksum in a drive, the watchdog's reaction, the override that ends it, and CLEAR are events."""
    rig = RunnerRig()
    rig.enable()
    rig.drive_ms(1_000, throttle=0.3)
    rig.events.clear()
    rig.deliver(with_crc_broken(rig.sender.commands(CommandValues())[0]))
    rig.step_ms()
    rig.runner.execute("driver_brakes 0.3", rig.now_ns)
    rig.runner.execute("driver_brakes 0", rig.now_ns)
    rig.deliver(*rig.sender.clearing())
    rig.step_ms(1)
    assert rig.events == [
        ("enabled", "released: a wrong checksum"),
        ("watchdog", "watchdog brakes: a wrong checksum (steering)"),
        ("readiness", "not ready: a wrong checksum"),
        ("done", "driver_brakes 0.3"),
        ("overridden", "override by the driver: brake"),
        ("watchdog", "watchdog stopped braking and waits for CLEAR: a wrong checksum (steering)"),
        ("done", "driver_brakes 0"),
        ("overridden", "override cleared"),
        ("watchdog", "watchdog cleared"),
        ("readiness", "ready"),
    ]


def test_a_gear_that_is_rejected() -> None:
    """A rejected gear is an event with the reason."""
    rig = RunnerRig()
    rig.deliver(rig.sender.gear(4))
    rig.step_ms()
    rig.deliver(rig.sender.gear(2))
    rig.step_ms()
    assert [kind for kind, _ in rig.events] == ["rejected", "rejected"]
    assert ["brake" in rig.events[0][1], "unsupported" in rig.events[1][1]] == [True, True]


def test_events_of_the_simulator() -> None:
    """Events of the simulator are returned once, with their own times."""
    rig = RunnerRig()
    rig.car.events.append(VehicleEvent(START_NS + 1, "lane_invasion", "to the left"))
    rig.runner.step(START_NS + 10 * NS_PER_MS)
    assert [(event.mono_ns, event.kind, event.text) for event in rig.runner.take_events()] == [
        (START_NS + 1, "event", "lane_invasion: to the left")
    ]
    rig.step_ms(20)
    assert rig.events == []


def test_unknown_commands_are_rejected() -> None:
    """An unknown command is rejected, an empty line is ignored, and `help` lists the commands."""
    rig = RunnerRig()
    rig.runner.execute("   ", rig.now_ns)
    assert rig.collect_events() == []
    rig.runner.execute("jump", rig.now_ns)
    ((kind, text),) = rig.collect_events()
    assert (kind, "'jump'" in text) == ("rejected", True)
    rig.runner.execute(" help\n", rig.now_ns)
    assert {kind for kind, _ in rig.collect_events()} == {"help"}


def test_a_command_is_executed_after_earlier_frames() -> None:
    """A command is executed at the given time, after the frames that were received before this time."""
    rig = RunnerRig()
    rig.deliver(*rig.sender.commands(CommandValues(brake=0.5)), rig.sender.system(1), rig.sender.gear(4))
    rig.runner.execute("driver_shifts PARK", rig.now_ns + NS_PER_MS)
    assert rig.car.kit.state.gear == Gear.PARK
    assert [kind for kind, _ in rig.collect_events()][:2] == ["enabled", "gear"]


def test_truth_datagrams() -> None:
    """There is one datagram with the newest truth after each advance of the simulator, and no datagram in between."""
    rig, receiver = RunnerRig(), TruthReceiver()
    assert rig.runner.make_truth_datagram() is not None
    assert rig.runner.make_truth_datagram() is None
    rig.car.events.append(VehicleEvent(START_NS + 1, "lane_invasion", "to the left"))
    rig.step_ms(10)
    datagram = rig.runner.make_truth_datagram()
    assert datagram is not None
    assert receiver.receive(datagram) == [VehicleEvent(START_NS + 1, "lane_invasion", "to the left")]
    assert receiver.newest == rig.car.simulator.ground_truth()
    assert rig.runner.make_truth_datagram() is None
    rig.step_ms(1)
    assert rig.runner.make_truth_datagram() is None
    rig.step_ms(500)
    datagram = rig.runner.make_truth_datagram()
    assert datagram is not None
    assert receiver.receive(datagram) == []
    assert rig.now_ns - receiver.newest.mono_ns <= STEP_NS


def test_steps_at_wake_times_are_never_late() -> None:
    """A step at each `next_wake_ns` is never late."""
    rig = RunnerRig()
    for _ in range(500):
        rig.now_ns = rig.runner.next_wake_ns()
        rig.step_ms()
    assert rig.runner.max_delay_ns == 0
    assert rig.now_ns - START_NS > NS_PER_S


def test_a_bus_that_is_lost_and_back() -> None:
    """The loss and the return of a bus are one event each, lost frames are counted, and the car advances."""
    rig = RunnerRig()
    rig.step_ms(20)
    rig.bus.gone_reason = "the cable is cut"
    rig.step_ms(100)
    rig.step_ms(2_000)
    assert rig.events == [("bus", "the bus is gone: the cable is cut")]
    assert rig.runner.counts["frames_lost"] == 2 * 210 + 3 * 105 + 3 * 21, "reports of 100, 50 and 10 Hz in 2.1 s"
    assert rig.now_ns - rig.car.simulator.state().mono_ns <= STEP_NS
    rig.bus.gone_reason = ""
    rig.step_ms(20)
    assert rig.events[1:] == []
    rig.step_ms(1_000)
    assert rig.events[1:] == [("bus", "the bus is back")]


def test_a_bus_that_is_full_now_and_then() -> None:
    """A bus that repeatedly rejects frames causes one event."""
    rig = RunnerRig()
    for index in range(100):
        rig.bus.gone_reason = "no room" if index % 2 else ""
        rig.step_ms(10)
    assert rig.events == [("bus", "the bus is gone: no room")]
