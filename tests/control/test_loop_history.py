"""What the states of the vehicle tell a client about when its commands take effect."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.control.loop_history import EffectDelay
from lavt.domain import NS_PER_MS, NS_PER_S, State

STEP_NS = 20 * NS_PER_MS
WALL_NS = 1_700_000_000 * NS_PER_S
"""The vehicle's wall clock at the start; this machine's monotonic clock begins with 0."""


def state(mono_ns: int, applied: int) -> State:
    """Return a state that the vehicle sends at this time since the start."""
    return State(
        sent_wall_ns=WALL_NS + mono_ns,
        state_mono_ns=mono_ns,
        speed_mps=8.0,
        steering_rad=0.0,
        gear="drive",
        safety="driving",
        reason="",
        applied_sequence=applied,
        rejected="",
    )


@given(st.integers(0, 400 * NS_PER_MS), st.integers(0, STEP_NS), st.integers(-(10**15), 10**15))
def test_the_delay_is_known_to_half_the_states_period(delay_ns: int, phase_ns: int, clock_ns: int) -> None:
    """Whatever the clocks and the phases, the states tell when commands take effect to 10 ms."""
    delay = EffectDelay()
    sent = [(number, number * STEP_NS) for number in range(60)]
    for number, at_ns in sent:
        delay.note_command(number, at_ns)
        now_ns = at_ns + phase_ns
        applied = max((n for n, t in sent[: number + 1] if t + delay_ns <= now_ns), default=-1)
        delay.note_state(state(now_ns + clock_ns, applied), now_ns)
    found_ns = delay.at_ns(sent[-1][1])
    assert found_ns is not None
    assert found_ns == pytest.approx(WALL_NS + clock_ns + delay_ns, abs=STEP_NS / 2 + 1)
    assert delay.at_ns(sent[-1][1] + NS_PER_S) is None


def test_a_clock_that_is_set_back_forgets_the_delay() -> None:
    """After the vehicle's clock was set back, the delay is unknown until a newly applied command bounds it again."""
    delay = EffectDelay()
    for number in range(4):
        delay.note_command(number, number * STEP_NS)
    for number, clock_ns in ((0, 0), (1, 0), (2, -NS_PER_S), (3, -NS_PER_S)):
        delay.note_state(state(number * STEP_NS + clock_ns, number), number * STEP_NS)
        if number == 2:
            assert delay.at_ns(number * STEP_NS) is None
    assert delay.at_ns(3 * STEP_NS) == WALL_NS - NS_PER_S - STEP_NS // 2
