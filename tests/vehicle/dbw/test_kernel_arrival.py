"""Arrival times of frames from the kernel's wall-clock timestamps."""

from __future__ import annotations

import pytest

from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.vehicle.dbw.kernel_arrival import ArrivalTimes

WALL_AHEAD_NS = 1_790_000_000 * NS_PER_S


def at(mono_ms: float, stepped_ms: float = 0) -> Now:
    """Return a reading of both clocks, after the wall clock was stepped by `stepped_ms`."""
    return Now(round(mono_ms * NS_PER_MS), WALL_AHEAD_NS + round((mono_ms + stepped_ms) * NS_PER_MS))


@pytest.mark.parametrize("read_ms", [101, 150, 4000])
def test_without_a_step(read_ms: int) -> None:
    """A timestamp gives the time of arrival, however late the frame is read."""
    arrivals = ArrivalTimes(at(90))
    assert arrivals.arrived_ns(at(100).wall_ns, at(read_ms)) == 100 * NS_PER_MS


@pytest.mark.parametrize("step_ms", [-3_600_000, -50, 50, 3_600_000])
@pytest.mark.parametrize("stepped_before", [True, False], ids=["arrived after the step", "arrived before it"])
def test_a_step_shortly_before_the_reading(step_ms: int, stepped_before: bool) -> None:
    """Whether a frame arrived before or after the step, it has its true time of arrival."""
    arrivals = ArrivalTimes(at(90))
    timestamp_ns = at(100, step_ms if stepped_before else 0).wall_ns
    assert arrivals.arrived_ns(timestamp_ns, at(101, step_ms)) == 100 * NS_PER_MS


@pytest.mark.parametrize("step_ms", [-3_600_000, -50, 50, 3_600_000])
def test_a_step_while_many_frames_wait(step_ms: int) -> None:
    """If the reader did not run during a step, a frame's time is at most the step too early, and never too late."""
    arrivals = ArrivalTimes(at(0))
    times_ns = [
        arrivals.arrived_ns(at(arrived_ms, step_ms if arrived_ms > 250 else 0).wall_ns, at(500, step_ms))
        for arrived_ms in range(10, 500, 10)
    ]
    assert times_ns == sorted(times_ns)
    for arrived_ms, arrived_ns in zip(range(10, 500, 10), times_ns, strict=True):
        assert -min(abs(step_ms), 500) * NS_PER_MS <= arrived_ns - arrived_ms * NS_PER_MS <= 0


def test_impossible_timestamps() -> None:
    """A timestamp that fits no reading gives the earliest possible time: of the previous frame or the empty queue."""
    arrivals = ArrivalTimes(at(90))
    assert arrivals.arrived_ns(0, at(101)) == 90 * NS_PER_MS
    assert arrivals.arrived_ns(at(95).wall_ns, at(102)) == 95 * NS_PER_MS
    assert arrivals.arrived_ns(0, at(103)) == 95 * NS_PER_MS
    assert arrivals.arrived_ns(at(10_000).wall_ns, at(104)) == 95 * NS_PER_MS
    assert arrivals.arrived_ns(at(105.9).wall_ns, at(105)) == 105 * NS_PER_MS


STEPS_MS = (-200, -60, -50, -40, -30, -1, 1, 30, 40, 50, 60, 200)


@pytest.mark.parametrize("step_ms", STEPS_MS)
@pytest.mark.parametrize("stepped_before", [True, False], ids=["arrived after the step", "arrived before it"])
def test_a_step_smaller_than_the_wait(step_ms: int, stepped_before: bool) -> None:
    """A frame's time is too early by the size of a step if two conditions are met; otherwise the time is true.

    The queue was found empty at least the size of the step before the arrival, and the clock was set back before the
    arrival or forward after it.
    """
    arrivals = ArrivalTimes(at(50))
    timestamp_ns = at(100, step_ms if stepped_before else 0).wall_ns
    is_too_early = abs(step_ms) <= 50 and (step_ms < 0) == stepped_before
    error_ns = arrivals.arrived_ns(timestamp_ns, at(110, step_ms)) - 100 * NS_PER_MS
    assert error_ns == (-abs(step_ms) * NS_PER_MS if is_too_early else 0)


@pytest.mark.parametrize("first_ms", STEPS_MS)
@pytest.mark.parametrize("second_ms", STEPS_MS)
def test_two_steps_during_one_wait(first_ms: int, second_ms: int) -> None:
    """If a frame arrives between two steps, its time is not before the last empty queue and not after the reading.

    The time is too late by at most the larger step. After two steps larger than 51 ms it is the earliest possible.
    """
    arrivals = ArrivalTimes(at(50))
    error_ns = arrivals.arrived_ns(at(100, first_ms).wall_ns, at(150, first_ms + second_ms)) - 100 * NS_PER_MS
    assert -50 * NS_PER_MS <= error_ns <= 50 * NS_PER_MS
    assert error_ns <= max(0, first_ms, -second_ms) * NS_PER_MS
    if abs(first_ms) > 51 and abs(second_ms) > 51:
        assert error_ns == -50 * NS_PER_MS
