"""Ticks of a world on a time grid, and the commands that are in force during them; no server is needed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, Actuation, CameraModel
from lavt.vehicle.carla.camera import CarlaCamera
from lavt.vehicle.carla.frames import FlatPose
from lavt.vehicle.carla.settings import CarlaEvent, Snapshot
from lavt.vehicle.carla.ticker import CommandHistory, Ticker
from lavt.vehicle.carla.ticks import FULL_BRAKE

START_NS = 1_000 * NS_PER_MS
PERIOD_S = 0.1
BRAKE = Actuation(0.0, 0.0, 1.0)
COMMANDS = st.lists(st.tuples(st.integers(1, 300), st.floats(-1, 1), st.floats(0, 1)), max_size=8)


class RecordedWorld:
    """A world that records its ticks."""

    def __init__(self) -> None:
        self.actuations: list[tuple[Actuation, bool]] = []
        self.events: list[CarlaEvent] = []

    def tick(self, actuation: Actuation, *, hand_brake: bool = False) -> Snapshot:
        """Record the tick."""
        self.actuations.append((actuation, hand_brake))
        return Snapshot(len(self.actuations), FlatPose(0.0, 0.0, 0.0), 0.0, 0.0, 1)

    def take_events(self) -> list[CarlaEvent]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events


def build(world: RecordedWorld) -> Ticker:
    return Ticker(world, first_due_ns=START_NS, period_s=PERIOD_S, actuation=BRAKE)


def test_ticks_are_made_when_they_are_due() -> None:
    """A tick is made at the start and then every period, however the time advances."""
    world = RecordedWorld()
    ticker = build(world)
    for to_ms, count in ((999, 0), (1000, 1), (1050, 1), (1350, 4), (1200, 4), (1400, 5)):
        ticker.tick_until(to_ms * NS_PER_MS)
        assert len(world.actuations) == count
    assert ticker.next_due_ns == 1500 * NS_PER_MS


def test_a_command_is_in_force_for_its_part_of_a_tick() -> None:
    """A tick has the mean of the commands of the period before it, weighted by time."""
    world = RecordedWorld()
    ticker = build(world)
    ticker.tick_until(START_NS)
    ticker.command(Actuation(0.4, 1.0, 0.0), START_NS + 25 * NS_PER_MS, hand_brake=False)
    ticker.tick_until(START_NS + 100 * NS_PER_MS)
    ticker.tick_until(START_NS + 200 * NS_PER_MS)
    first, second, third = (actuation for actuation, _ in world.actuations)
    assert first == BRAKE
    assert (second.steering_rad, second.throttle, second.brake) == pytest.approx((0.3, 0.75, 0.25))
    assert third == Actuation(0.4, 1.0, 0.0)
    assert [hand_brake for _, hand_brake in world.actuations] == [True, False, False]


def test_the_thread_brakes_when_the_actuator_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """While the actuator has not looked for ticks for more than 200 ms, the car brakes in each tick."""
    world = RecordedWorld()
    ticker = build(world)
    monkeypatch.setattr(ticker, "_is_threaded", True)
    ticker.tick_until(START_NS)
    ticker.command(Actuation(0.4, 1.0, 0.0), START_NS, hand_brake=False)
    for after_ms, silences in ((0, 0), (200, 0), (201, 1), (900, 1)):
        ticker.brake_if_silent(START_NS + after_ms * NS_PER_MS)
        assert ticker.counts["silences"] == silences
    monkeypatch.setattr(ticker, "_is_threaded", False)
    ticker.tick_until(START_NS + 100 * NS_PER_MS)
    assert world.actuations[-1] == (FULL_BRAKE, False)
    ticker.command(Actuation(0.1, 0.5, 0.0), START_NS + 100 * NS_PER_MS, hand_brake=False)
    monkeypatch.setattr(ticker, "_is_threaded", True)
    ticker.brake_if_silent(START_NS + 950 * NS_PER_MS)  # a last command of an actuator that hangs again
    assert ticker.counts["silences"] == 1
    monkeypatch.setattr(ticker, "_is_threaded", False)
    ticker.tick_until(START_NS + 200 * NS_PER_MS)
    assert world.actuations[-1] == (FULL_BRAKE, False)
    monkeypatch.setattr(ticker, "_is_threaded", True)
    ticker.tick_until(START_NS + 1000 * NS_PER_MS)
    ticker.brake_if_silent(START_NS + 1001 * NS_PER_MS)
    monkeypatch.setattr(ticker, "_is_threaded", False)
    ticker.command(Actuation(0.1, 0.5, 0.0), START_NS + 200 * NS_PER_MS, hand_brake=False)
    ticker.tick_until(START_NS + 300 * NS_PER_MS)
    assert world.actuations[-1] == (Actuation(0.1, 0.5, 0.0), False)


def test_the_camera_is_not_taken_for_the_actuator(monkeypatch: pytest.MonkeyPatch) -> None:
    """In real time, pictures that the camera node asks for do not hide that the actuator is silent."""
    ticker = build(RecordedWorld())
    monkeypatch.setattr(ticker, "_is_threaded", True)
    ticker.tick_until(START_NS)
    session: Any = SimpleNamespace(settings=SimpleNamespace(tick_timeout_s=1.0))
    camera = CarlaCamera(session, CameraModel(), rate_hz=1000.0, phase_ns=0, sensor_delay_ns=0)
    camera.ticker = ticker
    assert camera.capture(1, START_NS + 900 * NS_PER_MS, None) is None
    ticker.brake_if_silent(START_NS + 901 * NS_PER_MS)
    assert ticker.counts["silences"] == 1


def test_commands_during_a_stall_do_not_count_after_it() -> None:
    """A tick after skipped ones has the commands of its own period, not the older ones of the stall."""
    world = RecordedWorld()
    ticker = build(world)
    ticker.tick_until(START_NS)
    ticker.command(Actuation(0.4, 1.0, 0.0), START_NS, hand_brake=False)
    ticker.command(FULL_BRAKE, START_NS + 5000 * NS_PER_MS, hand_brake=False)
    ticker.skip(5000 * NS_PER_MS)
    assert ticker.next_due_ns == START_NS + 5200 * NS_PER_MS
    ticker.tick_until(START_NS + 5200 * NS_PER_MS)
    assert world.actuations[-1] == (FULL_BRAKE, False)


@given(COMMANDS)
def test_nothing_of_a_command_is_lost(commands: list[tuple[int, float, float]]) -> None:
    """The means of all ticks have the same integral over time as the commands."""
    history, at_ms, in_force, integral = CommandHistory(BRAKE, 0), 0, BRAKE, 0.0
    end_ms = 100 * (1 + sum(after_ms for after_ms, _, _ in commands) // 100)
    total = 0.0
    due_ms = 100
    for after_ms, steering_rad, throttle in [*commands, (end_ms + 1, 0.0, 0.0)]:
        next_ms = at_ms + after_ms
        while due_ms < min(next_ms, end_ms + 1):
            total += history.mean((due_ms - 100) * NS_PER_MS, due_ms * NS_PER_MS).steering_rad * 100
            due_ms += 100
        integral += in_force.steering_rad * (min(next_ms, end_ms) - at_ms)
        at_ms, in_force = next_ms, Actuation(steering_rad, throttle, 0.0)
        history.add(in_force, at_ms * NS_PER_MS)
    assert total == pytest.approx(integral, abs=1e-6)


def test_events_have_the_times_of_their_ticks() -> None:
    """An event that arrives a tick late still has the time of its own frame."""
    world = RecordedWorld()
    ticker = build(world)
    ticker.tick_until(START_NS + 100 * NS_PER_MS)
    world.events = [CarlaEvent(3, "collision", "b"), CarlaEvent(1, "lane_invasion", "a")]
    ticker.tick_until(START_NS + 200 * NS_PER_MS)
    events = [(at_ns // NS_PER_MS, event.detail) for at_ns, event in ticker.take_events()]
    assert events == [(1000, "a"), (1200, "b")]
    assert ticker.take_events() == []


def test_ticks_are_found_by_time() -> None:
    """The newest tick at a time is found, and there is none before the first."""
    ticker = build(RecordedWorld())
    ticker.tick_until(START_NS + 300 * NS_PER_MS)
    found = ticker.ticked_at(START_NS + 150 * NS_PER_MS)
    assert found is not None
    assert (found.due_ns, found.snapshot.frame) == (START_NS + 100 * NS_PER_MS, 2)
    assert ticker.ticked_at(START_NS - 1) is None
    assert [ticked.snapshot.frame for ticked in ticker.take_ticks(found.due_ns)] == [3, 4]
