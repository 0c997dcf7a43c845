"""Getting a kit to obey, driving by it, and letting go of it in order."""

from __future__ import annotations

import math
from collections import Counter
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise

import pytest
from tests.vehicle.dbw.rig import COARSE_MS, START_NS, Rig, both, driving, profile, road, started

from lavt.domain import NS_PER_MS, Actuation
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.profile import LEAST_GAP_NS, PERIOD_NS
from lavt.vehicle.dbw.states import TABLE
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.state import AXES, Gear

ALL = set(AXES)


def names(rig: Rig) -> list[str]:
    """Messages that were sent, by their names in the DBC."""
    known = {facts.identifier: name for name, facts in rig.profile.codec.messages.items()}
    return [known[frame.identifier] for _, frame in rig.sent]


@both
def test_idle_is_silent(generation: int) -> None:
    """Until driving is wanted nothing is sent, and nothing hinders: the car can be engaged, and is not."""
    rig = started(generation)
    rig.run_ms(1000)
    state = rig.adapter.state()
    assert rig.sent == []
    assert (state.inhibit_reason, state.is_engaged, state.is_overridden) == ("", False, False)
    assert (state.gear, state.speed_mps) == ("park", 0.0)


@both
def test_before_reports(generation: int) -> None:
    """Before every report has come once, their absence hinders, each by its name."""
    rig = Rig(generation, start_frames=False)
    inhibit_reason = rig.adapter.state().inhibit_reason
    assert inhibit_reason == "; ".join(f"no {message} yet" for message in rig.profile.reports)


@both
def test_engaging(generation: int) -> None:
    """CLEAR for 120 ms, all axes with the brake on, then DRIVE: the car obeys in the time of two gear reports."""
    rig = started(generation)
    rig.adapter.engage(True, rig.now_ns)
    passed_ms = rig.run_until(lambda rig: rig.state == "engaged")
    assert passed_ms <= 120 + 20 + 100 + 20
    assert rig.enabled() == ALL
    assert rig.kit.state.gear == Gear.DRIVE
    assert rig.adapter.state().is_engaged
    rig.run_ms(20)
    assert rig.kit.state.brake == 1.0
    assert next(moment.state for moment in rig.moments if moment.state != "idle") == "clearing"
    assert max(moment.wheels.throttle for moment in rig.moments) == 0.0
    assert rig.events == []


@both
def test_drive_waits_for_the_brake(generation: int) -> None:
    """Where no brake is asked for, the holding brake is on when DRIVE is asked for; so the shift is not refused."""
    rig = started(generation)
    rig.actuation = Actuation(0.0, 0.9, 0.0)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_until(lambda rig: rig.kit.state.gear == Gear.DRIVE)
    assert rig.kit.state.brake == pytest.approx(rig.profile.limits.holding_brake, abs=1e-3)
    assert rig.kit.state.throttle == 0.0
    rig.run_ms(300)
    assert rig.kit.state.throttle > 0.0


def test_clearing_frames_of_generation_1() -> None:
    """Generation 1 is cleared with frames of four bytes at 20 Hz, and the gearbox with its one byte."""
    rig = started(1)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "enabling")
    frames = [frame for _, frame in rig.sent]
    a_set = [
        CanFrame(0x064, bytes([0, 0, 2, 0])),
        CanFrame(0x060, bytes([0, 0, 0, 2])),
        CanFrame(0x062, bytes([0, 0, 0, 2])),
        CanFrame(0x066, bytes([0x80])),
    ]
    assert frames[:12] == a_set * 3
    times = sorted({at_ns for at_ns, _ in rig.sent})[:3]
    assert [later - earlier for earlier, later in pairwise(times)] == [50 * NS_PER_MS] * 2


@both
def test_counters(generation: int) -> None:
    """Counters go up by one with each frame that has one, also over a pause."""
    rig = driving(generation)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "idle", 20_000, step_ms=COARSE_MS)
    rig.run_ms(500)
    rig.engage()
    identifier = 0x064 if generation == 1 else 0x200
    data = [frame.data for _, frame in rig.sent if frame.identifier == identifier and len(frame.data) == 8]
    counts = [each[7] if generation == 1 else each[6] & 15 for each in data]
    modulus = 256 if generation == 1 else 16
    assert len(counts) > 100
    assert all((after - before) % modulus == 1 for before, after in pairwise(counts))


@both
def test_new_commands_go_at_once(generation: int) -> None:
    """A tick that brings something new sends it in the same millisecond, but no two sets are closer than 5 ms."""
    rig = driving(generation, tick_ms=1)
    rig.run_ms(500)
    rig.sent.clear()
    for index in range(60):
        rig.actuation = replace(rig.actuation, steering_rad=0.01 + index * 1e-4)
        rig.run_ms(1)
    times = sorted({at_ns for at_ns, _ in rig.sent})
    assert {later - earlier for earlier, later in pairwise(times)} == {5 * NS_PER_MS}
    rig.run_ms(100)
    rig.sent.clear()
    rig.actuation = replace(rig.actuation, steering_rad=0.02)
    rig.run_until(lambda rig: bool(rig.sent), 10)
    assert rig.adapter._sender.sent_ns == rig.now_ns


@both
def test_old_commands_are_repeated(generation: int) -> None:
    """What stays the same is sent again every 20 ms."""
    rig = driving(generation, tick_ms=4)
    rig.run_ms(1000)
    rig.sent.clear()
    rig.run_ms(200)
    times = sorted({at_ns for at_ns, _ in rig.sent})
    assert {later - earlier for earlier, later in pairwise(times)} == {PERIOD_NS}
    assert Counter(names(rig)).most_common(1)[0][1] == 10


@both
def test_steering_and_speed(generation: int) -> None:
    """The wheels turn as far as they were asked to, left positive, and the state says so, with the speed's own time."""
    rig = driving(generation)
    rig.actuation = Actuation(0.05, 0.1, 0.0)
    rig.run_ms(1000)
    state = rig.adapter.state()
    assert rig.simulator.state().steering_rad == pytest.approx(0.05, abs=1e-3)
    assert state.steering_rad == pytest.approx(0.05, abs=1e-3)
    assert state.speed_mps == pytest.approx(rig.speed_mps, abs=0.1)
    assert 0 <= rig.now_ns - state.mono_ns <= 20 * NS_PER_MS
    assert state.gear == "drive"


@both
def test_parking(generation: int) -> None:
    """A car that is not wanted any more brakes, is put into PARK once it stands, and only then let go of."""
    rig = driving(generation)
    rig.actuation = Actuation(0.0, 0.5, 0.0)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(100)
    assert rig.kit.state.throttle == 0.0
    assert rig.kit.state.brake == pytest.approx(rig.profile.limits.holding_brake, abs=1e-3)
    assert rig.enabled() == ALL
    rig.run_until(lambda rig: rig.kit.state.gear == Gear.PARK, 10_000)
    assert rig.enabled() == ALL
    rig.run_until(lambda rig: rig.state == "idle")
    assert rig.enabled() == set()
    assert rig.kit.state.watchdog == 0
    assert rig.speed_mps < 0.1
    assert rig.adapter.state().inhibit_reason == ""
    rig.sent.clear()
    rig.run_ms(300)
    assert rig.sent == []


@both
def test_no_park_by_one_report(generation: int) -> None:
    """PARK is asked for after 300 ms of standing: not because a report or two of a rolling car say that it stands."""
    rig = driving(generation)
    speed = {1: 0x065, 2: 0x107}[generation]
    lost: list[CanFrame] = []

    def lose(frame: CanFrame) -> bool:
        lost.extend([frame] * (frame.identifier == speed))
        return frame.identifier == speed

    rig.lose_report = lose
    rig.run_ms(50)
    moving = lost[-1].data
    standing = moving[:4] + bytes(2) + moving[6:] if generation == 1 else bytes(2) + moving[2:]
    if generation == 2:
        standing = standing[:-1] + bytes([frame_crc8(speed, standing[:-1])])
    rig.adapter.engage(False, rig.now_ns)
    for _ in range(10):
        rig.adapter.receive(CanFrame(speed, standing), rig.now_ns)
        rig.run_ms(20)
    assert rig.adapter.state().speed_mps == 0.0
    assert rig.speed_mps > 3.0
    assert rig.state == "parking"
    assert {1: 0x066, 2: 0x203}[generation] not in {frame.identifier for _, frame in rig.sent}
    rig.lose_report = lambda _: False
    rig.run_until(lambda rig: rig.kit.state.gear == Gear.PARK, 10_000)
    assert rig.speed_mps == 0.0


@both
def test_again(generation: int) -> None:
    """After it was parked the car can be engaged again."""
    rig = driving(generation)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "idle", 20_000, step_ms=COARSE_MS)
    rig.engage()
    assert rig.enabled() == ALL


@both
def test_not_wanted_while_enabling(generation: int) -> None:
    """What was begun is taken back in order where it is not wanted any more, at whatever moment."""
    begun = started(generation)
    begun.adapter.engage(True, begun.now_ns)
    for after_ms in range(0, 220, 7):
        rig = begun.copy()
        begun.run_ms(7)
        rig.adapter.engage(False, rig.now_ns)
        rig.run_until(lambda rig: rig.state == "idle" and not rig.enabled(), 1000)
        rig.run_ms(200)
        assert (rig.enabled(), rig.kit.state.gear, rig.kit.state.watchdog) == (set(), Gear.PARK, 0), after_ms


@both
def test_not_engaged_while_rolling(generation: int) -> None:
    """A car that moves is not engaged."""
    rig = driving(generation)
    rig.adapter = ByWireAdapter(rig.profile, start_ns=rig.now_ns)
    rig.is_ticking = False
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(1000)
    assert rig.speed_mps > 0.5
    assert rig.state == "idle"


def test_installation() -> None:
    """An installation that must not drive says why, and never engages."""
    rig = Rig(2, inhibit_reason="55 signals of dataspeed_gen2 are unverified")
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(1000)
    assert rig.sent == []
    assert rig.adapter.state().inhibit_reason == "55 signals of dataspeed_gen2 are unverified"


def test_unknown_sign() -> None:
    """Where nobody knows which sign of the steering is left, the car is not engaged."""
    known = profile("dataspeed_gen1")
    rig = Rig(1, profile=replace(known, car=replace(known.car, steering_sign=None)))
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(1000)
    assert rig.sent == []
    assert rig.adapter.state().inhibit_reason == "the steering's sign is not known: set vehicle.dbw.steering_sign"


@both
def test_other_sign(generation: int) -> None:
    """With the other sign both what is sent and what is reported are turned."""
    known = profile(f"dataspeed_gen{generation}")
    rig = driving(generation, profile=replace(known, car=replace(known.car, steering_sign=-1)))
    rig.actuation = Actuation(0.05, 0.1, 0.0)
    rig.run_ms(1000)
    assert rig.simulator.state().steering_rad == pytest.approx(-0.05, abs=1e-3)
    assert rig.adapter.state().steering_rad == pytest.approx(0.05, abs=1e-3)


def test_users_commands() -> None:
    """Generation 2 is driven by the user's set of commands too, and by no other than the kit hears."""
    rig = Rig(2, profile=profile("dataspeed_gen2:user"), commands="user")
    rig.engage()
    assert {frame.identifier for _, frame in rig.sent} == {0x210, 0x211, 0x212, 0x213, 0x216}
    deaf = Rig(2, profile=profile("dataspeed_gen2:user"), commands="remote")
    deaf.adapter.engage(True, deaf.now_ns)
    deaf.run_ms(1000)
    assert deaf.adapter.state().inhibit_reason == "RemoteReport has STATE remote"
    assert deaf.sent == []


@both
def test_reached(generation: int) -> None:
    """What the kit reports to steer by is told once, with when it was asked for, within 16 ms."""
    rig = driving(generation)
    rig.run_ms(500)
    rig.adapter.take_reached()
    rig.actuation = replace(rig.actuation, steering_rad=0.012)
    rig.run_until(lambda rig: rig.adapter._requested == rig.actuation)
    requested_ns = rig.now_ns
    rig.run_ms(200)
    reached = rig.adapter.take_reached()
    assert [each.applied_ns for each in reached] == [requested_ns]
    assert 0 < reached[0].reached_ns - requested_ns <= (5 + 10 + 1) * NS_PER_MS
    assert rig.adapter.take_reached() == []


@both
def test_reached_of_a_weave(generation: int) -> None:
    """While the wheel goes to and fro nothing is told to have reached it before it was asked for, or late."""
    rig = driving(generation, tick_ms=4)
    for index in range(1000):
        rig.actuation = Actuation(0.02 * math.sin(index / 20), 0.2, 0.0)
        rig.run_ms(1)
    reached = rig.adapter.take_reached()
    assert len(reached) > 80
    assert all(0 < each.reached_ns - each.applied_ns <= (5 + 10 + 1) * NS_PER_MS for each in reached)
    assert len({each.applied_ns for each in reached}) == len(reached)


@both
def test_drives_as_the_simulator(generation: int) -> None:
    """What is asked over CAN moves the car as what is asked of the simulator itself: to 0.1 m after 5 s."""
    rig = driving(generation)
    same = Simulator(road=road(), seed=1, start_mono_ns=START_NS)
    same._car, same._index = deepcopy(rig.simulator._car), rig.simulator._index
    started = rig.simulator.ground_truth()
    for step in range(250):
        requested = Actuation(0.01 * math.sin(step / 40), 0.2, 0.0)
        rig.actuation = requested
        same.apply(requested, rig.now_ns)
        rig.run_ms(20)
        same.advance(rig.now_ns)
    other, own = same.ground_truth(), rig.simulator.ground_truth()
    assert math.hypot(started.x_m - own.x_m, started.y_m - own.y_m) > 20
    assert math.hypot(other.x_m - own.x_m, other.y_m - own.y_m) < 0.1


def test_wake() -> None:
    """The adapter is never asleep longer than 100 ms, nor over what it has to do."""
    adapter = ByWireAdapter(profile("dataspeed_gen1"), start_ns=START_NS)
    assert adapter.next_wake_ns() == START_NS + 100 * NS_PER_MS
    rig = driving(1)
    for _ in range(50):
        wake_ns = rig.adapter.next_wake_ns()
        assert rig.now_ns < wake_ns <= rig.now_ns + PERIOD_NS
        rig.run_ms(1)


@both
def test_wake_when_overdue(generation: int) -> None:
    """A set of frames that is overdue wakes the adapter in the next nanosecond, not in the past."""
    rig = driving(generation)
    rig.run_until(lambda rig: rig.now_ns - rig.sent[-1][0] >= LEAST_GAP_NS if rig.sent else False)
    rig.adapter.ask(Actuation(0.1, 0.0, 0.0), rig.now_ns)
    assert rig.adapter.next_wake_ns() == rig.now_ns + 1


def test_table_is_whole() -> None:
    """Every state but idle can be left without wanting anything, and every state can be reached."""
    sources = {source for row in TABLE for source in row.sources}
    targets = {row.target for row in TABLE}
    assert sources == targets == {"idle", "clearing", "enabling", "engaged", "parking", "overridden", "lost"}


@both
def test_no_number_is_no_tick(generation: int) -> None:
    """An actuation that is no number is dropped and counted, and keeps nothing alive."""
    rig = driving(generation)
    rig.actuation = Actuation(math.nan, 0.1, 0.0)
    stopped_ns = rig.now_ns
    rig.run_ms(300)
    assert rig.adapter.counts["actuations_rejected"] == 15
    assert max(at_ns for at_ns, _ in rig.sent) - stopped_ns <= 60 * NS_PER_MS
