"""The machine's two clocks, read together."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from lavt import clock
from lavt.clock import ATTEMPTS, MachineClock
from lavt.domain import NS_PER_MS, Now


class StandInTime:
    """Gives the times it was given, one at a reading."""

    def __init__(self, mono_ns: Iterator[int], wall_ns: Iterator[int]) -> None:
        self.monotonic_ns = mono_ns.__next__
        self.time_ns = wall_ns.__next__


def test_readings_that_other_work_came_between_are_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pair of times is of one moment, though the processor was away for 5 ms between the readings at first."""
    mono_ns = iter([0, 5 * NS_PER_MS, 5 * NS_PER_MS + 50])
    monkeypatch.setattr(clock, "time", StandInTime(mono_ns, iter([1000, 1000 + 5 * NS_PER_MS])))

    assert MachineClock().now() == Now(5 * NS_PER_MS + 50, 1000 + 5 * NS_PER_MS)


def test_a_machine_without_a_quiet_moment_is_read_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where something comes between at every attempt, the last one counts."""
    mono_ns, wall_ns = (iter(range(0, 100 * NS_PER_MS, NS_PER_MS)) for _ in range(2))
    monkeypatch.setattr(clock, "time", StandInTime(mono_ns, wall_ns))

    assert MachineClock().now() == Now(ATTEMPTS * NS_PER_MS, (ATTEMPTS - 1) * NS_PER_MS)
