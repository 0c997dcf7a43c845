from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.rtp.adaptive_hold import AdaptiveHold

MIN_HOLD_NS, MAX_HOLD_NS, WINDOW_NS = 10 * NS_PER_MS, 300 * NS_PER_MS, 30 * NS_PER_S
"""The limits in docs/video.md."""


@pytest.mark.parametrize(
    ("reordered_ms", "hold_ms"), [(0, 10), (7, 10), (8, 10), (40, 50), (240, 300), (300, 300), (301, 10)]
)
def test_the_hold(reordered_ms: int, hold_ms: int) -> None:
    """The hold is 1.25 times the reordering delay, within bounds; delays beyond the upper bound are ignored."""
    hold = AdaptiveHold()
    hold.note_delay(reordered_ms * NS_PER_MS, 0)
    assert hold.hold_ns(NS_PER_S) == hold_ms * NS_PER_MS


def test_a_delay_is_forgotten_after_30_to_60_s() -> None:
    """A reordering delay affects the hold until the end of the window after the one in which it was noted."""
    hold = AdaptiveHold()
    hold.note_delay(0, 0)
    hold.note_delay(40 * NS_PER_MS, WINDOW_NS - 1)
    assert hold.hold_ns(2 * WINDOW_NS - 1) == 50 * NS_PER_MS
    assert hold.hold_ns(2 * WINDOW_NS) == MIN_HOLD_NS
    hold.note_delay(40 * NS_PER_MS, 2 * WINDOW_NS)
    assert hold.hold_ns(4 * WINDOW_NS - 1) == 50 * NS_PER_MS
    assert hold.hold_ns(4 * WINDOW_NS) == MIN_HOLD_NS


@given(st.lists(st.tuples(st.integers(0, 60 * NS_PER_S), st.integers(0, 2 * NS_PER_S))))
def test_the_hold_is_within_bounds(pauses_and_delays: list[tuple[int, int]]) -> None:
    """The hold is between 10 and 300 ms for any reordering delays."""
    hold, now_ns = AdaptiveHold(), 0
    for pause_ns, reordered_ns in pauses_and_delays:
        now_ns += pause_ns
        hold.note_delay(reordered_ns, now_ns)
        assert MIN_HOLD_NS <= hold.hold_ns(now_ns) <= MAX_HOLD_NS
