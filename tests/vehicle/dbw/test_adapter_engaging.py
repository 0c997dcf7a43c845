"""Engaging a kit, driving through it, and disengaging it in order."""

from __future__ import annotations

import math
from collections import Counter
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise

import msgspec
import pytest
from tests.vehicle.dbw.rig import (
    COARSE_MS,
    SPEED_SOURCES,
    START_NS,
    AdapterRig,
    both_generations,
    driving_rig,
    profile,
    road,
    stationary_rig,
)

from lavt.domain import NS_PER_MS, Actuation
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.profile import LEAST_GAP_NS, REPEAT_PERIOD_NS
from lavt.vehicle.dbw.states import TABLE
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.state import AXES, Gear

ALL_AXES = set(AXES)
CLEARING_MS = 120
"""Time in the state `clearing`."""
SET_MS = 20
"""Longest time until the next set of frames."""
PEDAL_REPORT_MS, GEAR_REPORT_MS = 20, 100
"""Periods of the pedals' and the gear's reports."""
MAX_REACHED_MS = 5 + 10 + 1
"""Longest time from a request to the report of it: the shortest time between two sets of frames, the period of the
steering reports, and a step of the rig."""


def sent_messages(rig: AdapterRig) -> list[str]:
    """Return the DBC's names of the messages that were sent."""
    names_by_identifier = {message.identifier: name for name, message in rig.profile.codec.messages.items()}
    return [names_by_identifier[frame.identifier] for _, frame in rig.sent]


@both_generations
def test_idle_is_silent(generation: int) -> None:
    """In `idle` nothing is sent, there is no inhibit reason, and the car is not engaged."""
    rig = stationary_rig(generation)
    rig.run_ms(1000)
    state = rig.adapter.state()
    assert rig.sent == []
    assert (state.inhibit_reason, state.is_engaged, state.is_overridden) == ("", False, False)
    assert (state.gear, state.speed_mps) == ("park", 0.0)


@both_generations
def test_missing_reports_inhibit(generation: int) -> None:
    """Until every report has arrived once, the inhibit reason names each missing report."""
    rig = AdapterRig(generation, start_frames=False)
    inhibit_reason = rig.adapter.state().inhibit_reason
    assert inhibit_reason == "; ".join(f"no {message} yet" for message in rig.profile.reports)


@both_generations
def test_engaging(generation: int) -> None:
    """Engaging clears for 120 ms, enables all axes with the brake on, and shifts to DRIVE, all as early as possible."""
    rig = stationary_rig(generation)
    rig.adapter.engage(True, rig.now_ns)
    passed_ms = rig.run_until(lambda rig: rig.state == "engaged")
    assert passed_ms <= CLEARING_MS + PEDAL_REPORT_MS + SET_MS + GEAR_REPORT_MS
    assert rig.enabled() == ALL_AXES
    assert rig.kit.state.gear == Gear.DRIVE
    assert rig.adapter.state().is_engaged
    rig.run_ms(20)
    assert rig.kit.state.brake == 1.0
    assert next(moment.state for moment in rig.moments if moment.state != "idle") == "clearing"
    assert max(moment.wheels.throttle for moment in rig.moments) == 0.0
    assert rig.events == []


@both_generations
def test_drive_is_requested_with_the_brake(generation: int) -> None:
    """DRIVE is requested with the holding brake on, even if no brake is requested, so that it is not rejected."""
    rig = stationary_rig(generation)
    rig.actuation = Actuation(0.0, 0.9, 0.0)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_until(lambda rig: rig.kit.state.gear == Gear.DRIVE)
    assert rig.kit.state.brake == pytest.approx(rig.profile.limits.holding_brake, abs=1e-3)
    assert rig.kit.state.throttle == 0.0
    rig.run_ms(300)
    assert rig.kit.state.throttle > 0.0


def test_clearing_frames_of_generation_1() -> None:
    """Generation 1 is cleared with frames of four bytes at 20 Hz, and its gearbox with a frame of one byte."""
    rig = stationary_rig(1)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "enabling")
    frames = [frame for _, frame in rig.sent]
    frame_set = [
        CanFrame(0x064, bytes([0, 0, 2, 0])),
        CanFrame(0x060, bytes([0, 0, 0, 2])),
        CanFrame(0x062, bytes([0, 0, 0, 2])),
        CanFrame(0x066, bytes([0x80])),
    ]
    assert frames[:12] == frame_set * 3
    times = sorted({at_ns for at_ns, _ in rig.sent})[:3]
    assert [later - earlier for earlier, later in pairwise(times)] == [50 * NS_PER_MS] * 2


@both_generations
def test_counters(generation: int) -> None:
    """Counters increase by one with each frame, even across a pause."""
    rig = driving_rig(generation)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "idle", 20_000, step_ms=COARSE_MS)
    rig.run_ms(500)
    rig.engage()
    identifier = 0x064 if generation == 1 else 0x200
    data = [frame.data for _, frame in rig.sent if frame.identifier == identifier and len(frame.data) == 8]
    counts = [frame_data[7] if generation == 1 else frame_data[6] & 15 for frame_data in data]
    modulus = 256 if generation == 1 else 16
    assert len(counts) > 100
    assert all((after - before) % modulus == 1 for before, after in pairwise(counts))


@both_generations
def test_new_commands_are_sent_immediately(generation: int) -> None:
    """A new command is sent in the millisecond of its tick, but sets of frames are at least 5 ms apart."""
    rig = driving_rig(generation, tick_ms=1)
    rig.run_ms(500)
    rig.sent.clear()
    for index in range(60):
        rig.actuation = msgspec.structs.replace(rig.actuation, steering_rad=0.01 + index * 1e-4)
        rig.run_ms(1)
    times = sorted({at_ns for at_ns, _ in rig.sent})
    assert {later - earlier for earlier, later in pairwise(times)} == {5 * NS_PER_MS}
    rig.run_ms(100)
    rig.sent.clear()
    rig.actuation = msgspec.structs.replace(rig.actuation, steering_rad=0.02)
    rig.run_until(lambda rig: bool(rig.sent), 10)
    assert rig.adapter._sender.last_set_ns == rig.now_ns


@both_generations
def test_unchanged_commands_are_repeated(generation: int) -> None:
    """An unchanged command is sent every 20 ms."""
    rig = driving_rig(generation, tick_ms=4)
    rig.run_ms(1000)
    rig.sent.clear()
    rig.run_ms(200)
    times = sorted({at_ns for at_ns, _ in rig.sent})
    assert {later - earlier for earlier, later in pairwise(times)} == {REPEAT_PERIOD_NS}
    ((_, most_frames),) = Counter(sent_messages(rig)).most_common(1)
    assert most_frames == 10


@both_generations
def test_steering_and_speed(generation: int) -> None:
    """The wheels follow the requested angle, left positive; the state has the angle, the speed and the speed's time."""
    rig = driving_rig(generation)
    rig.actuation = Actuation(0.05, 0.1, 0.0)
    rig.run_ms(1000)
    state = rig.adapter.state()
    assert rig.simulator.state().steering_rad == pytest.approx(0.05, abs=1e-3)
    assert state.steering_rad == pytest.approx(0.05, abs=1e-3)
    assert state.speed_mps == pytest.approx(rig.speed_mps, abs=0.1)
    assert 0 <= rig.now_ns - state.mono_ns <= 20 * NS_PER_MS
    assert state.gear == "drive"


@both_generations
def test_parking(generation: int) -> None:
    """When driving is no longer wanted the car brakes, shifts to PARK once stationary, and only then is disengaged."""
    rig = driving_rig(generation)
    rig.actuation = Actuation(0.0, 0.5, 0.0)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(100)
    assert rig.kit.state.throttle == 0.0
    assert rig.kit.state.brake == pytest.approx(rig.profile.limits.holding_brake, abs=1e-3)
    assert rig.enabled() == ALL_AXES
    rig.run_until(lambda rig: rig.kit.state.gear == Gear.PARK, 10_000)
    assert rig.enabled() == ALL_AXES
    rig.run_until(lambda rig: rig.state == "idle")
    assert rig.enabled() == set()
    assert rig.kit.state.watchdog_reason == 0
    assert rig.speed_mps < 0.1
    assert rig.adapter.state().inhibit_reason == ""
    rig.sent.clear()
    rig.run_ms(300)
    assert rig.sent == []


@both_generations
def test_no_park_while_locked_wheels_slide(generation: int) -> None:
    """PARK is not requested while the car slides with locked wheels, although all reported speeds are 0."""
    rig = driving_rig(generation)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.speed_mps < 2.0)
    for source in SPEED_SOURCES[generation]:  # the wheels lock
        rig.kit.stick_speed(source, 0.0)
    rig.run_until(lambda rig: rig.speed_mps < 0.1)
    assert rig.adapter.state().speed_mps == 0.0
    assert rig.state == "parking"
    assert {1: 0x066, 2: 0x203}[generation] not in {frame.identifier for _, frame in rig.sent}
    rig.run_until(lambda rig: rig.kit.state.gear == Gear.PARK, 10_000)
    assert rig.speed_mps == 0.0


@both_generations
def test_a_parked_car_can_be_engaged_again(generation: int) -> None:
    """A car that was parked can be engaged again."""
    rig = driving_rig(generation)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "idle", 20_000, step_ms=COARSE_MS)
    rig.engage()
    assert rig.enabled() == ALL_AXES


@both_generations
def test_engaging_can_be_cancelled(generation: int) -> None:
    """Engaging that is cancelled at any moment leaves the car in PARK, disengaged, without a watchdog trip."""
    engaging_rig = stationary_rig(generation)
    engaging_rig.adapter.engage(True, engaging_rig.now_ns)
    for after_ms in range(0, 220, 7):
        rig = engaging_rig.copy()
        engaging_rig.run_ms(7)
        rig.adapter.engage(False, rig.now_ns)
        rig.run_until(lambda rig: rig.state == "idle" and not rig.enabled(), 1000)
        rig.run_ms(200)
        assert (rig.enabled(), rig.kit.state.gear, rig.kit.state.watchdog_reason) == (set(), Gear.PARK, 0), after_ms


@both_generations
def test_not_engaged_while_rolling(generation: int) -> None:
    """A moving car is not engaged."""
    rig = driving_rig(generation)
    rig.adapter = ByWireAdapter(rig.profile, start_ns=rig.now_ns)
    rig.is_ticking = False
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(1000)
    assert rig.speed_mps > 0.5
    assert rig.state == "idle"


def test_an_inhibited_installation_is_not_engaged() -> None:
    """An installation with an inhibit reason reports it and is never engaged."""
    rig = AdapterRig(2, inhibit_reason="55 signals of dataspeed_gen2 are unverified")
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(1000)
    assert rig.sent == []
    assert rig.adapter.state().inhibit_reason == "55 signals of dataspeed_gen2 are unverified"


def test_an_unknown_steering_sign_inhibits() -> None:
    """A car whose steering sign is not known is not engaged."""
    base_profile = profile("dataspeed_gen1")
    rig = AdapterRig(1, profile=replace(base_profile, car=replace(base_profile.car, steering_sign=None)))
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(1000)
    assert rig.sent == []
    assert "steering_sign" in rig.adapter.state().inhibit_reason


@both_generations
def test_negative_steering_sign(generation: int) -> None:
    """With the negative steering sign, sent and reported angles are inverted."""
    base_profile = profile(f"dataspeed_gen{generation}")
    rig = driving_rig(generation, profile=replace(base_profile, car=replace(base_profile.car, steering_sign=-1)))
    rig.actuation = Actuation(0.05, 0.1, 0.0)
    rig.run_ms(1000)
    assert rig.simulator.state().steering_rad == pytest.approx(-0.05, abs=1e-3)
    assert rig.adapter.state().steering_rad == pytest.approx(0.05, abs=1e-3)


def test_user_commands() -> None:
    """Generation 2 can be driven with its user commands, but only if the kit accepts them."""
    rig = AdapterRig(2, profile=profile("dataspeed_gen2:user"), commands="user")
    rig.engage()
    assert {frame.identifier for _, frame in rig.sent} == {0x210, 0x211, 0x212, 0x213, 0x216}
    remote_rig = AdapterRig(2, profile=profile("dataspeed_gen2:user"), commands="remote")
    remote_rig.adapter.engage(True, remote_rig.now_ns)
    remote_rig.run_ms(1000)
    # The message RemoteReport says in its signal STATE that the kit accepts remote commands.
    assert remote_rig.adapter.state().inhibit_reason == "RemoteReport has STATE remote"
    assert remote_rig.sent == []


@both_generations
def test_reached(generation: int) -> None:
    """A steering command that the kit reports is reached once, at most 16 ms after its request."""
    rig = driving_rig(generation)
    rig.run_ms(500)
    rig.adapter.take_reached()
    rig.actuation = msgspec.structs.replace(rig.actuation, steering_rad=0.012)
    rig.run_until(lambda rig: rig.adapter._requested == rig.actuation)
    requested_ns = rig.now_ns
    rig.run_ms(200)
    reached = rig.adapter.take_reached()
    assert [command.applied_ns for command in reached] == [requested_ns]
    assert 0 < reached[0].reached_ns - requested_ns <= MAX_REACHED_MS * NS_PER_MS
    assert rig.adapter.take_reached() == []


@both_generations
def test_reached_while_weaving(generation: int) -> None:
    """While the wheel turns to and fro, each reached command is reported at most 16 ms after its request."""
    rig = driving_rig(generation, tick_ms=4)
    for index in range(1000):
        rig.actuation = Actuation(0.02 * math.sin(index / 20), 0.2, 0.0)
        rig.run_ms(1)
    reached = rig.adapter.take_reached()
    assert len(reached) > 80
    assert all(0 < command.reached_ns - command.applied_ns <= MAX_REACHED_MS * NS_PER_MS for command in reached)
    assert len({command.applied_ns for command in reached}) == len(reached)


@both_generations
def test_drives_as_the_simulator(generation: int) -> None:
    """After 5 s, a car driven over CAN is less than 0.1 m from a simulator that was driven directly in the same way."""
    rig = driving_rig(generation)
    reference = Simulator(road=road(), seed=1, start_mono_ns=START_NS)
    reference._car, reference._index = deepcopy(rig.simulator._car), rig.simulator._index
    start = rig.simulator.ground_truth()
    for step in range(250):
        requested = Actuation(0.01 * math.sin(step / 40), 0.2, 0.0)
        rig.actuation = requested
        reference.apply(requested, rig.now_ns)
        rig.run_ms(20)
        reference.advance(rig.now_ns)
    expected, end = reference.ground_truth(), rig.simulator.ground_truth()
    assert math.hypot(start.x_m - end.x_m, start.y_m - end.y_m) > 20
    assert math.hypot(expected.x_m - end.x_m, expected.y_m - end.y_m) < 0.1


def test_wake() -> None:
    """The adapter's next wake time is at most 100 ms away and never later than its next frames."""
    adapter = ByWireAdapter(profile("dataspeed_gen1"), start_ns=START_NS)
    assert adapter.next_wake_ns() == START_NS + 100 * NS_PER_MS
    rig = driving_rig(1)
    for _ in range(50):
        wake_ns = rig.adapter.next_wake_ns()
        assert rig.now_ns < wake_ns <= rig.now_ns + REPEAT_PERIOD_NS
        rig.run_ms(1)


@both_generations
def test_wake_when_overdue(generation: int) -> None:
    """An overdue set of frames makes the next wake time the next nanosecond, not a time in the past."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: rig.now_ns - rig.sent[-1][0] >= LEAST_GAP_NS if rig.sent else False)
    rig.adapter.set_actuation(Actuation(0.1, 0.0, 0.0), rig.now_ns)
    assert rig.adapter.next_wake_ns() == rig.now_ns + 1


def test_every_state_is_reachable() -> None:
    """Every state can be entered and left."""
    sources = {source for row in TABLE for source in row.sources}
    targets = {row.target for row in TABLE}
    assert sources == targets == {"idle", "clearing", "enabling", "engaged", "parking", "overridden", "lost"}


@both_generations
def test_a_non_finite_actuation_is_no_tick(generation: int) -> None:
    """A non-finite actuation is dropped and counted, and is no tick."""
    rig = driving_rig(generation)
    rig.actuation = Actuation(math.nan, 0.1, 0.0)
    stopped_ns = rig.now_ns
    rig.run_ms(300)
    assert rig.adapter.counts["actuations_rejected"] == 15
    assert max(at_ns for at_ns, _ in rig.sent) - stopped_ns <= 60 * NS_PER_MS


@both_generations
@pytest.mark.parametrize("after_ms", [0, 1, 10, 19, 60])
def test_enabling_cancelled_early_disables_the_kit(generation: int, after_ms: int) -> None:
    """If enabling in gear is cancelled, even before the kit has reported its axes, the car is parked, then disabled."""
    rig = stationary_rig(generation)
    rig.actuation = Actuation(0.0, 0.0, 1.0)
    rig.kit.driver_shifts(Gear.NEUTRAL, rig.now_ns)
    rig.run_ms(200)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "enabling")
    rig.run_ms(after_ms)
    rig.adapter.engage(False, rig.now_ns)
    gears = set()
    while rig.state != "idle":
        rig.run_ms(1)
        gears.add(rig.kit.state.gear)
    assert (Gear.DRIVE in gears) == (after_ms == 60)
    assert (rig.enabled(), rig.kit.state.gear, rig.kit.state.watchdog_reason) == (set(), Gear.PARK, 0)
    assert rig.events == []
