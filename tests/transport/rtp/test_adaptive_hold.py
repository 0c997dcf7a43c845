from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.rtp.adaptive_hold import AdaptiveHold

MIN_HOLD_NS, MAX_HOLD_NS, WINDOW_NS = 10 * NS_PER_MS, 300 * NS_PER_MS, 30 * NS_PER_S
"""The limits that docs/video.md states."""


@pytest.mark.parametrize(
    ("reordered_ms", "hold_ms"), [(0, 10), (7, 10), (8, 10), (40, 50), (240, 300), (300, 300), (301, 10)]
)
def test_the_hold(reordered_ms: int, hold_ms: int) -> None:
    """A quarter longer than what was seen, within bounds; what is beyond them is not waited for."""
    hold = AdaptiveHold()
    hold.note(reordered_ms * NS_PER_MS, 0)
    assert hold.at(NS_PER_S) == hold_ms * NS_PER_MS


def test_it_forgets_after_30_to_60_s() -> None:
    """Windows follow one another without a gap, whenever somebody looks."""
    hold = AdaptiveHold()
    hold.note(0, 0)
    hold.note(40 * NS_PER_MS, WINDOW_NS - 1)
    assert hold.at(2 * WINDOW_NS - 1) == 50 * NS_PER_MS
    assert hold.at(2 * WINDOW_NS) == MIN_HOLD_NS
    hold.note(40 * NS_PER_MS, 2 * WINDOW_NS)
    assert hold.at(4 * WINDOW_NS - 1) == 50 * NS_PER_MS
    assert hold.at(4 * WINDOW_NS) == MIN_HOLD_NS


@given(st.lists(st.tuples(st.integers(0, 60 * NS_PER_S), st.integers(0, 2 * NS_PER_S))))
def test_it_is_within_bounds(notes: list[tuple[int, int]]) -> None:
    """Whatever is seen when."""
    hold, now_ns = AdaptiveHold(), 0
    for pause_ns, reordered_ns in notes:
        now_ns += pause_ns
        hold.note(reordered_ns, now_ns)
        assert MIN_HOLD_NS <= hold.at(now_ns) <= MAX_HOLD_NS
