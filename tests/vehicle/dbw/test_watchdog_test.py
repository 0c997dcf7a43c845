"""That a kit's watchdog brakes is proved only by a kit that was left alone and brakes."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from tests.vehicle.dbw.rig import START_NS, both, profile, road

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, VehicleState
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.profile import OwnBrake
from lavt.vehicle.dbw.watchdog_test import WatchdogTest
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.kit import Kit
from lavt.vehicle.software_car.state import Gear

BRAKE_REPORTS = {1: 0x061, 2: 0x101}
GEAR_COMMANDS = {1: 0x066, 2: 0x203}


class Attempt:
    """One attempt on a software car; `meddle` is called each millisecond, `spoil` changes or loses what it reports."""

    def __init__(self, generation: int, *, has_watchdog: bool = True) -> None:
        self.profile, self.generation = profile(f"dataspeed_gen{generation}"), generation
        assert self.profile.watchdog is not None
        self.proving = WatchdogTest(self.profile, self.profile.watchdog, start_ns=START_NS)
        self.simulator = Simulator(road=road(), seed=1, start_mono_ns=START_NS)
        self.kit = Kit(1 if generation == 1 else 2, start_ns=START_NS, has_watchdog=has_watchdog)
        self.car = SoftwareCar(self.kit, self.simulator)
        self.sent: list[tuple[int, CanFrame]] = []
        self.now_ns = START_NS
        self.meddle: Callable[[int], None] = lambda _: None
        self.spoil: Callable[[CanFrame], CanFrame | None] = lambda frame: frame

    def run(self) -> WatchdogTest:
        """Let it go on until it is done."""
        for _ in range(20_000):
            if self.proving.is_done:
                return self.proving
            self.now_ns += NS_PER_MS
            self.meddle((self.now_ns - START_NS) // NS_PER_MS)
            for frame in self.car.advance(self.now_ns):
                if (spoiled := self.spoil(frame)) is not None:
                    self.proving.receive(spoiled, self.now_ns)
            for frame in self.proving.frames_due(self.now_ns):
                self.sent.append((self.now_ns, frame))
                self.car.receive(frame, self.now_ns)
        raise AssertionError("it does not end")

    def is_enabled(self) -> bool:
        """The kit obeys."""
        return all(actuator.is_enabled for actuator in self.kit.state.actuators.values())


@both
def test_proved(generation: int) -> None:
    """A kit with its watchdog lets go 100 ms after the last frame, brakes, and so is proved; in park, as it was."""
    attempt = Attempt(generation)
    proving = attempt.run()
    assert proving.failure == ""
    assert proving.observation is not None
    assert 100 * NS_PER_MS <= proving.observation.released_ns == proving.observation.braked_ns <= 121 * NS_PER_MS
    assert proving.observation.reports == 49  # each 20 ms; the first came before the silence was known to be one
    assert "watchdog has tripped" in proving.observation.kit_messages
    assert attempt.kit.state.gear == Gear.PARK
    assert not any(frame.identifier == GEAR_COMMANDS[generation] for _, frame in attempt.sent)


@both
def test_held(generation: int) -> None:
    """The kit is enabled for half a second, with a brake of 0.3 and no throttle; then nothing leaves any more."""
    attempt = Attempt(generation)
    enabled: list[int] = []
    pedals: set[tuple[float, float]] = set()

    def look(_: int) -> None:
        if attempt.is_enabled():
            enabled.append(attempt.now_ns)
            pedals.add((attempt.kit.state.throttle, round(attempt.kit.state.brake, 3)))

    attempt.meddle = look
    attempt.run()
    assert max(pedals) == (0.0, 0.3)
    last_ns = attempt.sent[-1][0]
    assert last_ns - enabled[0] > 480 * NS_PER_MS
    assert enabled[-1] - last_ns <= 100 * NS_PER_MS
    assert attempt.now_ns - last_ns == NS_PER_S


def test_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """While the kit is enabled, the adapter has a tick each 20 ms, and none once the silence has begun."""
    attempt = Attempt(1)
    ticks_ns: list[int] = []
    ask = attempt.proving._adapter.set_actuation

    def record(actuation: Actuation, now_ns: int) -> None:
        ticks_ns.append(now_ns)
        ask(actuation, now_ns)

    monkeypatch.setattr(attempt.proving._adapter, "ask", record)
    attempt.run()
    began_ns, last_ns = attempt.sent[0][0], attempt.sent[-1][0]
    in_time = [each_ns for each_ns in ticks_ns if each_ns >= began_ns]
    assert {after - before for before, after in pairwise(in_time)} == {20 * NS_PER_MS}
    assert in_time[-1] - last_ns < 20 * NS_PER_MS


@both
def test_without_watchdog(generation: int) -> None:
    """A kit without its watchdog lets go and does not brake: nothing is proved."""
    proving = Attempt(generation, has_watchdog=False).run()
    assert proving.observation is None
    assert proving.failure.startswith("the kit did not brake within 500 ms")


def delayed(attempt: Attempt, by_ms: int) -> Callable[[CanFrame], CanFrame | None]:
    """The watchdog's brake comes later than it does."""
    gone: list[int] = []

    def spoil(frame: CanFrame) -> CanFrame | None:
        if frame.identifier != BRAKE_REPORTS[attempt.generation] or not attempt.kit.state.watchdog_brakes:
            return frame
        gone.append(attempt.now_ns)
        if attempt.now_ns - gone[0] >= by_ms * NS_PER_MS:
            return frame
        data = bytearray(frame.data)
        data[6] &= 0xF7
        return CanFrame(frame.identifier, bytes(data))

    return spoil


@pytest.mark.parametrize(("by_ms", "is_proved"), [(360, True), (420, False)])
def test_late(by_ms: int, is_proved: bool) -> None:
    """A brake that comes more than 500 ms after the last frame proves nothing."""
    attempt = Attempt(1)
    attempt.spoil = delayed(attempt, by_ms)
    proving = attempt.run()
    assert (proving.observation is not None) is is_proved
    if not is_proved:
        assert ", but only after 5" in proving.failure


def test_brakes_and_lets_go() -> None:
    """A kit that brakes for a moment only proves nothing."""
    attempt = Attempt(1)

    def meddle(_: int) -> None:
        if attempt.kit.state.watchdog_brakes and attempt.now_ns - attempt.sent[-1][0] > 300 * NS_PER_MS:
            attempt.kit.state.watchdog_brakes = False

    attempt.meddle = meddle
    assert attempt.run().failure.endswith("ms only, and let go again")


@both
def test_driver_brakes(generation: int) -> None:
    """A foot on the brake is no watchdog: not before, not while the kit is enabled, not in the silence."""
    before = Attempt(generation)
    before.kit.driver_brakes(0.4, START_NS)
    during = Attempt(generation)
    during.meddle = lambda ms: (
        during.kit.driver_brakes(0.4, during.now_ns) if during.is_enabled() and ms > 800 else None
    )
    after = Attempt(generation, has_watchdog=False)

    def in_the_silence(_: int) -> None:
        if after.sent and after.now_ns - after.sent[-1][0] > 70 * NS_PER_MS:
            after.kit.driver_brakes(0.4, after.now_ns)

    after.meddle = in_the_silence
    for attempt in (before, during, after):
        proving = attempt.run()
        assert proving.observation is None
        assert proving.failure


def test_brakes_already() -> None:
    """A brake that is put out before anything was sent is no proof, and nothing is sent."""
    attempt = Attempt(2)
    attempt.kit.driver_brakes(0.02, START_NS)  # too little to count as an override
    assert attempt.run().failure.startswith("the kit brakes by itself")
    assert attempt.sent == []


def unsealed(frame: CanFrame) -> CanFrame:
    return CanFrame(frame.identifier, frame.data[:-1] + bytes([frame.data[-1] ^ 1]))


HINDERED: list[tuple[Callable[[Attempt], object], str]] = [
    (lambda it: setattr(it, "spoil", lambda _: None), "the kit is not heard: no "),
    (lambda it: setattr(it, "spoil", unsealed), "the kit is not heard: no "),
    (lambda it: setattr(it.kit.state, "gear", Gear.DRIVE), "the gear is drive: put it into park or neutral"),
    (lambda it: it.kit.set_fault("steering.fault", START_NS), "the kit cannot be enabled: the steering has a fault"),
    (lambda it: it.kit.inhibit("door", START_NS), "the kit cannot be enabled: a door is open"),
    (lambda it: it.kit.switch_remote(1, START_NS), "the kit cannot be enabled: RemoteReport has STATE pause"),
    (lambda it: it.proving.receive(CanFrame(0x201, bytes(8)), START_NS), "somebody else commands the kit (0x201)"),
    (lambda it: it.proving.on_bus_gone("pulled out"), "the bus is gone: pulled out"),
]


@pytest.mark.parametrize(("inhibit", "failure"), HINDERED, ids=[each[1][:40] for each in HINDERED])
def test_hindered(inhibit: Callable[[Attempt], object], failure: str) -> None:
    """Whatever keeps the kit from being enabled at standstill is said, and nothing is sent."""
    attempt = Attempt(2)
    inhibit(attempt)
    proving = attempt.run()
    assert proving.observation is None
    assert proving.failure.startswith(failure)
    assert attempt.sent == []


def test_moving(monkeypatch: pytest.MonkeyPatch) -> None:
    """A car that moves is left alone."""
    attempt = Attempt(2)
    sense = attempt.kit.sense
    monkeypatch.setattr(
        attempt.kit, "sense", lambda state, now_ns: sense(VehicleState(now_ns, 0.2, 0.0, state.gear), now_ns)
    )
    assert attempt.run().failure.startswith("the car does not stand")
    assert attempt.sent == []


def test_not_enabled() -> None:
    """A kit that does not come up is said, with what it reports."""
    attempt = Attempt(2)
    attempt.meddle = lambda ms: attempt.kit.switch_remote(1, attempt.now_ns) if ms == 600 else None
    proving = attempt.run()
    assert proving.observation is None
    assert proving.failure.startswith("the kit did not stay enabled: ")


def test_still_enabled() -> None:
    """A kit that goes on without commands is the worst, and said."""
    attempt = Attempt(1)

    def spoil(frame: CanFrame) -> CanFrame:
        if frame.identifier != 0x061 or not attempt.sent:
            return frame
        return CanFrame(0x061, frame.data[:7] + bytes([frame.data[7] | 1]))

    attempt.spoil = spoil
    assert attempt.run().failure.startswith("the kit did not let go")


def test_other_signal() -> None:
    """What counts is the signal that the profile names: one that is never set proves nothing."""
    attempt = Attempt(1)
    attempt.proving = WatchdogTest(attempt.profile, OwnBrake("BrakeReport", "BC", 0.0), start_ns=START_NS)
    assert attempt.run().failure.startswith("the kit did not brake")
    assert attempt.profile.watchdog == OwnBrake("BrakeReport", "WDCBRK", 0.0)
