"""The watchdog test passes only for a kit that brakes after sending stopped."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from tests.vehicle.dbw.rig import START_NS, both_generations, profile, road

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
    """One run of the test on a software car; `meddle` is called each millisecond, `spoil` changes or drops reports."""

    def __init__(self, generation: int, *, has_watchdog: bool = True) -> None:
        self.profile, self.generation = profile(f"dataspeed_gen{generation}"), generation
        assert self.profile.watchdog is not None
        self.test = WatchdogTest(self.profile, self.profile.watchdog, start_ns=START_NS)
        self.simulator = Simulator(road=road(), seed=1, start_mono_ns=START_NS)
        self.kit = Kit(1 if generation == 1 else 2, start_ns=START_NS, has_watchdog=has_watchdog)
        self.car = SoftwareCar(self.kit, self.simulator)
        self.sent: list[tuple[int, CanFrame]] = []
        self.now_ns = START_NS
        self.meddle: Callable[[int], None] = lambda _: None
        self.spoil: Callable[[CanFrame], CanFrame | None] = lambda frame: frame

    def run(self) -> WatchdogTest:
        """Run until the test is done."""
        for _ in range(20_000):
            if self.test.is_done:
                return self.test
            self.now_ns += NS_PER_MS
            self.meddle((self.now_ns - START_NS) // NS_PER_MS)
            for frame in self.car.advance(self.now_ns):
                if (spoiled := self.spoil(frame)) is not None:
                    self.test.receive(spoiled, self.now_ns)
            for frame in self.test.frames_due(self.now_ns):
                self.sent.append((self.now_ns, frame))
                self.car.receive(frame, self.now_ns)
        raise AssertionError("the test does not end")

    def is_enabled(self) -> bool:
        """Return whether all axes of the kit are enabled."""
        return all(actuator.is_enabled for actuator in self.kit.state.actuators.values())


@both_generations
def test_passed(generation: int) -> None:
    """The test passes for a kit that disengages and brakes 100 ms after the last frame; the test leaves it in PARK."""
    attempt = Attempt(generation)
    test = attempt.run()
    assert test.failure == ""
    assert test.observation is not None
    assert 100 * NS_PER_MS <= test.observation.released_ns == test.observation.braked_ns <= 121 * NS_PER_MS
    assert test.observation.reports == 49  # one each 20 ms; the first precedes the monitoring
    assert "watchdog has tripped" in test.observation.kit_messages
    assert attempt.kit.state.gear == Gear.PARK
    assert not any(frame.identifier == GEAR_COMMANDS[generation] for _, frame in attempt.sent)


@both_generations
def test_enabled_for_half_a_second(generation: int) -> None:
    """The kit is enabled for half a second, with a brake of 0.3 and no throttle; then nothing is sent any more."""
    attempt = Attempt(generation)
    enabled: list[int] = []
    pedals: set[tuple[float, float]] = set()

    def record(_: int) -> None:
        if attempt.is_enabled():
            enabled.append(attempt.now_ns)
            pedals.add((attempt.kit.state.throttle, round(attempt.kit.state.brake, 3)))

    attempt.meddle = record
    attempt.run()
    assert max(pedals) == (0.0, 0.3)
    last_ns, _ = attempt.sent[-1]
    assert last_ns - enabled[0] > 480 * NS_PER_MS
    assert enabled[-1] - last_ns <= 100 * NS_PER_MS
    assert attempt.now_ns - last_ns == NS_PER_S


def test_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """While the kit is enabled the adapter has a tick each 20 ms, and none after the last frame."""
    attempt = Attempt(1)
    ticks_ns: list[int] = []
    set_actuation = attempt.test._adapter.set_actuation

    def record(actuation: Actuation, now_ns: int) -> None:
        ticks_ns.append(now_ns)
        set_actuation(actuation, now_ns)

    monkeypatch.setattr(attempt.test._adapter, "set_actuation", record)
    attempt.run()
    (began_ns, _), *_, (last_ns, _) = attempt.sent
    sending_ns = [tick_ns for tick_ns in ticks_ns if tick_ns >= began_ns]
    assert {after - before for before, after in pairwise(sending_ns)} == {20 * NS_PER_MS}
    assert sending_ns[-1] - last_ns < 20 * NS_PER_MS


@both_generations
def test_without_watchdog(generation: int) -> None:
    """The test fails for a kit without watchdog, which disengages and does not brake."""
    test = Attempt(generation, has_watchdog=False).run()
    assert test.observation is None
    assert "did not brake within 500 ms" in test.failure


def delayed(attempt: Attempt, by_ms: int) -> Callable[[CanFrame], CanFrame | None]:
    """Return a function that delays the watchdog's brake in the reports."""
    braking_ns: list[int] = []

    def spoil(frame: CanFrame) -> CanFrame | None:
        if frame.identifier != BRAKE_REPORTS[attempt.generation] or not attempt.kit.state.watchdog_brakes:
            return frame
        braking_ns.append(attempt.now_ns)
        if attempt.now_ns - braking_ns[0] >= by_ms * NS_PER_MS:
            return frame
        data = bytearray(frame.data)
        data[6] &= 0xF7  # without WDCBRK
        return CanFrame(frame.identifier, bytes(data))

    return spoil


@pytest.mark.parametrize(("by_ms", "is_passed"), [(360, True), (420, False)])
def test_late(by_ms: int, is_passed: bool) -> None:
    """The test fails if the kit brakes more than 500 ms after the last frame."""
    attempt = Attempt(1)
    attempt.spoil = delayed(attempt, by_ms)
    test = attempt.run()
    assert (test.observation is not None) is is_passed
    if not is_passed:
        assert ", but only after 5" in test.failure


def test_brakes_and_releases() -> None:
    """The test fails if the kit brakes only for a moment."""
    attempt = Attempt(1)

    def meddle(_: int) -> None:
        if attempt.kit.state.watchdog_brakes and attempt.now_ns - attempt.sent[-1][0] > 300 * NS_PER_MS:
            attempt.kit.state.watchdog_brakes = False

    attempt.meddle = meddle
    assert "released the brake again" in attempt.run().failure


@both_generations
def test_driver_brakes(generation: int) -> None:
    """The test fails if the driver brakes before anything is sent, while the kit is enabled, or afterwards."""
    before = Attempt(generation)
    before.kit.driver_brakes(0.4, START_NS)
    during = Attempt(generation)
    during.meddle = lambda ms: (
        during.kit.driver_brakes(0.4, during.now_ns) if during.is_enabled() and ms > 800 else None
    )
    after = Attempt(generation, has_watchdog=False)

    def brake_after_the_last_frame(_: int) -> None:
        if after.sent and after.now_ns - after.sent[-1][0] > 70 * NS_PER_MS:
            after.kit.driver_brakes(0.4, after.now_ns)

    after.meddle = brake_after_the_last_frame
    for attempt in (before, during, after):
        test = attempt.run()
        assert test.observation is None
        assert test.failure


def test_brakes_already() -> None:
    """The test fails without sending anything if the kit already brakes."""
    attempt = Attempt(2)
    attempt.kit.driver_brakes(0.02, START_NS)  # too little for an override
    assert "brakes before anything was sent" in attempt.run().failure
    assert attempt.sent == []


def with_wrong_checksum(frame: CanFrame) -> CanFrame:
    return CanFrame(frame.identifier, frame.data[:-1] + bytes([frame.data[-1] ^ 1]))


INHIBITED: list[tuple[Callable[[Attempt], object], str]] = [
    (lambda attempt: setattr(attempt, "spoil", lambda _: None), "reports are missing: no "),
    (lambda attempt: setattr(attempt, "spoil", with_wrong_checksum), "reports are missing: no "),
    (lambda attempt: setattr(attempt.kit.state, "gear", Gear.DRIVE), "the gear is drive"),
    (lambda attempt: attempt.kit.set_fault("steering.fault", START_NS), "the steering has a fault"),
    (lambda attempt: attempt.kit.inhibit("door", START_NS), "a door is open"),
    (lambda attempt: attempt.kit.switch_remote(1, START_NS), "RemoteReport has STATE pause"),
    (lambda attempt: attempt.test.receive(CanFrame(0x201, bytes(8)), START_NS), "leave the bus to this program"),
    (lambda attempt: attempt.test.receive(CanFrame(0x216, bytes(2)), START_NS), "leave the bus to this program"),
    (lambda attempt: attempt.test.on_bus_gone("pulled out"), "pulled out"),
]


@pytest.mark.parametrize(("inhibit", "failure"), INHIBITED, ids=[failure[:40] for _, failure in INHIBITED])
def test_inhibited(inhibit: Callable[[Attempt], object], failure: str) -> None:
    """If the kit must not be enabled at standstill, the test fails with the reason and without sending anything."""
    attempt = Attempt(2)
    inhibit(attempt)
    test = attempt.run()
    assert test.observation is None
    assert failure in test.failure
    assert attempt.sent == []


def test_moving(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test fails without sending anything if the car moves."""
    attempt = Attempt(2)
    sense = attempt.kit.sense
    monkeypatch.setattr(
        attempt.kit, "sense", lambda state, now_ns: sense(VehicleState(now_ns, 0.2, 0.0, state.gear), now_ns)
    )
    assert "moving" in attempt.run().failure
    assert attempt.sent == []


def test_not_enabled() -> None:
    """The test fails with the kit's reason if the kit does not stay enabled."""
    attempt = Attempt(2)
    attempt.meddle = lambda ms: attempt.kit.switch_remote(1, attempt.now_ns) if ms == 600 else None
    test = attempt.run()
    assert test.observation is None
    assert "did not stay enabled: " in test.failure


def test_still_enabled() -> None:
    """The test fails if the kit stays enabled without commands."""
    attempt = Attempt(1)

    def spoil(frame: CanFrame) -> CanFrame:
        if frame.identifier != 0x061 or not attempt.sent:
            return frame
        return CanFrame(0x061, frame.data[:7] + bytes([frame.data[7] | 1]))

    attempt.spoil = spoil
    assert "did not release the brake" in attempt.run().failure


def test_signal_of_the_profile() -> None:
    """The test fails if the signal that the profile names is never set."""
    attempt = Attempt(1)
    attempt.test = WatchdogTest(attempt.profile, OwnBrake("BrakeReport", "BC", 0.0), start_ns=START_NS)
    assert "did not brake" in attempt.run().failure
    assert attempt.profile.watchdog == OwnBrake("BrakeReport", "WDCBRK", 0.0)
