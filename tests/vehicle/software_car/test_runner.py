"""A software car in real time, with the time told to it."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from tests.vehicle.software_car.rig import START_NS, Asked, Hand2, with_crc_broken
from tests.vehicle.software_car.test_in_process_bus import port_of

from lavt.domain import NS_PER_MS, NS_PER_S, VehicleEvent
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame
from lavt.vehicle.ground_truth_wire import TruthReceiver
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.runner import SoftwareCarRunner
from lavt.vehicle.software_car.state import Gear

STEP_NS = NS_PER_S // 240 + 1


class Bus:
    """A port of which a test is the other end."""

    def __init__(self) -> None:
        self.sent: list[tuple[CanFrame, int]] = []
        self.coming: list[ReceivedCanFrame] = []
        self.gone = ""
        self.counts: dict[str, int] = {}

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> None:
        """Keep frames."""
        if self.gone:
            raise BusGone(self.gone)
        self.sent += [(frame, made_ns) for frame in frames]

    def take(self, _now_ns: int) -> list[ReceivedCanFrame]:
        """Give what a test lets come."""
        if self.gone:
            raise BusGone(self.gone)
        taken, self.coming = self.coming, []
        return taken

    def next_wake_ns(self) -> None:
        """Nobody knows."""

    def close(self) -> None:
        """Nothing."""


class Life:
    """A runner, its bus, who commands it, and the time."""

    def __init__(self) -> None:
        self.bus, self.hand = Bus(), Hand2()
        self.car: SoftwareCar = port_of(2).car
        self.runner = SoftwareCarRunner(self.car, self.bus, start_ns=START_NS)
        self.now_ns = START_NS
        self.said: list[tuple[str, str]] = []

    def come(self, *frames: CanFrame, at_ns: int | None = None) -> None:
        """Let frames come from the bus."""
        self.bus.coming += [ReceivedCanFrame(frame, self.now_ns if at_ns is None else at_ns) for frame in frames]

    def step_ms(self, passed_ms: float = 0) -> None:
        """Let time pass, then step once."""
        self.now_ns += round(passed_ms * NS_PER_MS)
        self.runner.step(self.now_ns)
        self.listen()

    def listen(self) -> list[tuple[str, str]]:
        """Take the news."""
        events = [(each.kind, each.text) for each in self.runner.take_events()]
        self.said += events
        return events

    def enable(self) -> None:
        """Enable the kit and shift into drive."""
        self.come(*self.hand.commands(Asked(brake=0.5)), self.hand.system(1), self.hand.gear(4))
        self.step_ms()

    def drive_ms(self, duration_ms: int, **keys: float) -> None:
        """Command every 20 ms."""
        for _ in range(duration_ms // 20):
            self.come(*self.hand.commands(Asked(**keys)))  # type: ignore[arg-type]
            self.step_ms(20)


def test_reports_carry_their_own_times() -> None:
    """However late a step is, each frame is given to the bus with the time at which it was due."""
    life = Life()
    life.step_ms(35)
    due = [(frame.identifier, (made_ns - START_NS) / NS_PER_MS) for frame, made_ns in life.bus.sent]
    fast, slow = (0x100, 0x2A4), (0x100, 0x101, 0x102, 0x107, 0x2A4)
    assert due == [*((each, 10) for each in fast), *((each, 20) for each in slow), *((each, 30) for each in fast)]


def test_the_car_catches_up() -> None:
    """After a step that is late by 0.3 s the car has taken all its steps, and its time-outs have run at theirs."""
    life = Life()
    life.enable()
    life.drive_ms(1_000, throttle=0.3)
    wake_ns = life.runner.next_wake_ns()
    life.now_ns += 300 * NS_PER_MS
    life.runner.step(life.now_ns)
    events = life.runner.take_events()
    assert life.now_ns - life.car.simulator.state().mono_ns <= STEP_NS
    (watchdog,) = [each for each in events if each.kind == "watchdog"]
    assert watchdog.text == "watchdog brakes: no command in time (brake)"
    assert watchdog.mono_ns == life.now_ns - 220 * NS_PER_MS
    assert life.runner.latest_ns == life.now_ns - wake_ns


def test_frames_are_taken_at_the_time_they_came() -> None:
    """A command that came 15 ms before the step times out 100 ms after it came."""
    life = Life()
    life.step_ms(20)
    life.come(*life.hand.commands(Asked(brake=0.5)), at_ns=life.now_ns + 5 * NS_PER_MS)
    life.step_ms(20)
    assert life.car.kit.state.actuators["brake"].received_ns == START_NS + 25 * NS_PER_MS
    assert life.runner.counts["frames_heard"] == 3


@pytest.mark.parametrize(("at_ms", "taken_ms"), [(-1000, 20), (1000, 40)])
def test_times_that_cannot_be(at_ms: int, taken_ms: int) -> None:
    """A frame from before the car's present or from the future is taken in the present."""
    life = Life()
    life.step_ms(20)
    life.come(*life.hand.commands(Asked(brake=0.5)), at_ns=START_NS + at_ms * NS_PER_MS)
    life.step_ms(20)
    assert life.car.kit.state.actuators["brake"].received_ns == START_NS + taken_ms * NS_PER_MS


def test_the_news_of_a_drive() -> None:
    """What happens is told once, in order: enabling, the gear, the driver who takes over, letting go, clearing."""
    life = Life()
    life.enable()
    life.drive_ms(200, throttle=0.3)
    life.runner.execute("driver_steers 3", life.now_ns)
    life.listen()
    life.drive_ms(100, throttle=0.3)
    life.runner.execute("driver_steers 0", life.now_ns)
    life.come(*life.hand.clearing())
    life.step_ms(1)
    assert life.said == [
        ("enabled", "obeys: steering, brake, throttle"),
        ("gear", "gear DRIVE"),
        ("done", "driver_steers 3"),
        ("enabled", "lets go: the driver has taken over"),
        ("overridden", "taken over by the driver: steering"),
        ("readiness", "not ready: the driver has taken over"),
        ("done", "driver_steers 0"),
        ("overridden", "taken over by the driver: nothing any more"),
        ("readiness", "ready"),
    ]


def test_the_news_of_the_watchdog() -> None:
    """A wrong checksum while driving is told with what the watchdog does, until somebody takes over and clears it."""
    life = Life()
    life.enable()
    life.drive_ms(1_000, throttle=0.3)
    life.said.clear()
    life.come(with_crc_broken(life.hand.commands(Asked())[0]))
    life.step_ms()
    life.runner.execute("driver_brakes 0.3", life.now_ns)
    life.runner.execute("driver_brakes 0", life.now_ns)
    life.come(*life.hand.clearing())
    life.step_ms(1)
    assert life.said == [
        ("enabled", "lets go: a wrong checksum"),
        ("watchdog", "watchdog brakes: a wrong checksum (steering)"),
        ("readiness", "not ready: a wrong checksum"),
        ("done", "driver_brakes 0.3"),
        ("overridden", "taken over by the driver: brake"),
        ("watchdog", "watchdog brakes no more, and waits for CLEAR: a wrong checksum (steering)"),
        ("done", "driver_brakes 0"),
        ("overridden", "taken over by the driver: nothing any more"),
        ("watchdog", "watchdog cleared"),
        ("readiness", "ready"),
    ]


def test_a_gear_that_is_rejected() -> None:
    """A gear that cannot be had is told with the reason."""
    life = Life()
    life.come(life.hand.gear(4))
    life.step_ms()
    life.come(life.hand.gear(2))
    life.step_ms()
    assert life.said == [
        ("rejected", "gear 4 refused: the brake is not pressed, or the car moves"),
        ("rejected", "gear 2 refused: this car has no such gear"),
    ]


def test_what_happens_on_the_road_is_news() -> None:
    """Events of the simulator are told with their own times, and once."""
    life = Life()
    life.car.events.append(VehicleEvent(START_NS + 1, "lane_invasion", "to the left"))
    life.runner.step(START_NS + 10 * NS_PER_MS)
    assert [(each.mono_ns, each.kind, each.text) for each in life.runner.take_events()] == [
        (START_NS + 1, "event", "lane_invasion: to the left")
    ]
    life.step_ms(20)
    assert life.said == []


def test_words_that_are_none() -> None:
    """A word that is none is answered, an empty line is not, and `help` lists all."""
    life = Life()
    life.runner.execute("   ", life.now_ns)
    assert life.listen() == []
    life.runner.execute("jump", life.now_ns)
    assert life.listen() == [("rejected", "there is no word 'jump': help lists them")]
    life.runner.execute(" help\n", life.now_ns)
    assert {kind for kind, _ in life.listen()} == {"help"}


def test_a_word_is_done_after_what_came_before_it() -> None:
    """A word is done at its time: what was heard before it is taken first."""
    life = Life()
    life.come(*life.hand.commands(Asked(brake=0.5)), life.hand.system(1), life.hand.gear(4))
    life.runner.execute("driver_shifts PARK", life.now_ns + NS_PER_MS)
    assert life.car.kit.state.gear == Gear.PARK
    assert [kind for kind, _ in life.listen()][:2] == ["enabled", "gear"]


def test_the_truth_is_told_for_each_step() -> None:
    """There is a datagram whenever the simulator has moved on, with the newest truth, and none in between."""
    life, receiver = Life(), TruthReceiver()
    assert life.runner.make_truth_datagram() is not None
    assert life.runner.make_truth_datagram() is None
    life.car.events.append(VehicleEvent(START_NS + 1, "lane_invasion", "to the left"))
    life.step_ms(10)
    datagram = life.runner.make_truth_datagram()
    assert datagram is not None
    assert receiver.receive(datagram) == [VehicleEvent(START_NS + 1, "lane_invasion", "to the left")]
    assert receiver.newest == life.car.simulator.ground_truth()
    assert life.runner.make_truth_datagram() is None
    life.step_ms(1)
    assert life.runner.make_truth_datagram() is None
    life.step_ms(500)
    datagram = life.runner.make_truth_datagram()
    assert datagram is not None
    assert receiver.receive(datagram) == []
    assert life.now_ns - receiver.newest.mono_ns <= STEP_NS


def test_waking_as_it_asks() -> None:
    """Who steps at each `next_wake_ns` is never late."""
    life = Life()
    for _ in range(500):
        life.now_ns = life.runner.next_wake_ns()
        life.step_ms()
    assert life.runner.latest_ns == 0
    assert life.now_ns - START_NS > NS_PER_S


def test_a_bus_that_goes_and_comes_back() -> None:
    """A bus that has gone is told once, its frames are counted, and the car lives on; then it is told once more."""
    life = Life()
    life.step_ms(20)
    life.bus.gone = "the cable is cut"
    life.step_ms(100)
    life.step_ms(2_000)
    assert life.said == [("bus", "the bus is gone: the cable is cut")]
    assert life.runner.counts["frames_lost"] == 2 * 210 + 3 * 105 + 3 * 21
    assert life.now_ns - life.car.simulator.state().mono_ns <= STEP_NS
    life.bus.gone = ""
    life.step_ms(20)
    assert life.said[1:] == []
    life.step_ms(1_000)
    assert life.said[1:] == [("bus", "the bus is there again")]


def test_a_bus_that_is_full_now_and_then() -> None:
    """A bus that refuses frames now and then is told to be gone once, not each time."""
    life = Life()
    for index in range(100):
        life.bus.gone = "no room" if index % 2 else ""
        life.step_ms(10)
    assert life.said == [("bus", "the bus is gone: no room")]
