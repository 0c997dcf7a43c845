"""The machine's two clocks, read together."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from lavt import clock
from lavt.clock import MAX_ATTEMPTS, MachineClock
from lavt.domain import NS_PER_MS, Now


class FakeTime:
    """A `time` module that returns given times, one for each reading."""

    def __init__(self, mono_ns: Iterator[int], wall_ns: Iterator[int]) -> None:
        self.monotonic_ns = mono_ns.__next__
        self.time_ns = wall_ns.__next__


def test_an_interrupted_reading_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reading of both clocks that was interrupted for 5 ms is repeated."""
    # The order of the readings: monotonic, wall, monotonic; then, in the repetition, wall, monotonic.
    mono_ns, wall_ns = iter([0, 5 * NS_PER_MS, 5 * NS_PER_MS + 50]), iter([1000, 1000 + 5 * NS_PER_MS])
    monkeypatch.setattr(clock, "time", FakeTime(mono_ns, wall_ns))

    assert MachineClock().now() == Now(5 * NS_PER_MS + 50, 1000 + 5 * NS_PER_MS)


def test_the_last_attempt_is_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    """If every attempt is interrupted, the result of the last attempt is returned."""
    mono_ns, wall_ns = (iter(range(0, 100 * NS_PER_MS, NS_PER_MS)) for _ in range(2))
    monkeypatch.setattr(clock, "time", FakeTime(mono_ns, wall_ns))

    assert MachineClock().now() == Now(MAX_ATTEMPTS * NS_PER_MS, (MAX_ATTEMPTS - 1) * NS_PER_MS)
