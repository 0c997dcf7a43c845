from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.control.human_controls import HUMAN_LIMITS, LOST, HumanControls, HumanInput
from lavt.domain import NS_PER_MS

STEP_NS = 20 * NS_PER_MS
START_NS = 10**12
OPEN = HumanInput(0, False, True, 0.0, 0.0, 0.0)
HELD = replace(OPEN, is_held=True)


class Hand:
    """Controls to which a page is attached, with the time of the next input."""

    def __init__(self) -> None:
        self.controls = HumanControls(wheelbase_m=2.8)
        self.now_ns = START_NS
        self.controls.attach(self.now_ns)

    def give(self, new: HumanInput, *, age_ns: int = 0, count: int = 1) -> str:
        """Give inputs that have seen a message of age `age_ns`, one in each step; return the state of the hand."""
        for _ in range(count):
            self.now_ns += STEP_NS
            self.controls.handle(replace(new, seen_ns=self.now_ns - age_ns), self.now_ns)
        return self.controls.hand(self.now_ns)


def test_a_hand_must_be_seen_open_before_it_holds() -> None:
    """A control that is held from the beginning does not count; a press after an open hand does."""
    hand = Hand()
    assert hand.give(HELD, count=50) == "not_seen"
    assert hand.give(OPEN) == "open"
    assert hand.give(HELD) == "held"
    assert hand.give(OPEN) == "open"


@pytest.mark.parametrize("loss", ["not_live", "old_input", "no_input", "reconnected"])
def test_after_a_loss_only_a_new_press_counts(loss: str) -> None:
    """After a hidden page, old inputs, a gap or another page, a control that is still held does not count."""
    hand = Hand()
    hand.give(OPEN)
    assert hand.give(HELD) == "held"
    match loss:
        case "not_live":
            assert hand.give(replace(HELD, is_live=False)) == loss
        case "old_input":
            assert hand.give(HELD, age_ns=HUMAN_LIMITS.lock_after_ns + 1) == loss
        case "no_input":
            hand.now_ns += HUMAN_LIMITS.lock_after_ns
            assert hand.controls.hand(hand.now_ns) == loss
        case _:
            hand.controls.detach()
            assert hand.controls.hand(hand.now_ns) == "no_page"
            hand.controls.attach(hand.now_ns)
    assert hand.give(HELD, count=20) in LOST
    assert hand.give(OPEN) == "open"
    assert hand.give(HELD) == "held"


def test_a_gap_locks_although_nobody_looked() -> None:
    """The first input after a gap is not a hold, although the state was not read during the gap."""
    hand = Hand()
    hand.give(OPEN)
    hand.give(HELD)
    hand.now_ns += HUMAN_LIMITS.lock_after_ns
    assert hand.give(HELD) == "no_input"
    assert hand.give(HELD, count=20) == "no_input"


def test_a_short_pause_is_bridged() -> None:
    """During a short pause the hand does not hold, but after it the same press still counts."""
    hand = Hand()
    hand.give(OPEN)
    hand.give(HELD)
    hand.now_ns += HUMAN_LIMITS.input_timeout_ns
    assert hand.controls.hand(hand.now_ns) == "no_input"
    assert hand.give(HELD, age_ns=HUMAN_LIMITS.input_age_ns + 1) == "no_input"
    assert hand.give(HELD) == "held"


def test_a_burst_of_old_inputs_drives_nothing() -> None:
    """The inputs that a stopped page sends when it continues are dropped, also if they contain an open hand."""
    hand = Hand()
    hand.give(OPEN)
    hand.give(HELD)
    seen_ns = hand.now_ns
    hand.now_ns += 3000 * NS_PER_MS
    for new in (OPEN, HELD, OPEN, HELD):
        hand.controls.handle(replace(new, seen_ns=seen_ns, throttle=1.0), hand.now_ns)
        assert hand.controls.hand(hand.now_ns) in LOST
    assert hand.controls.counts["inputs_old"] == 4
    assert hand.controls.decide(0.0).throttle == 0


def test_old_inputs_do_not_feed_the_watchdog() -> None:
    """Inputs that are dropped do not count as inputs: the latch stays locked while only such inputs arrive."""
    hand = Hand()
    hand.give(OPEN)
    assert hand.give(HELD, age_ns=HUMAN_LIMITS.input_age_ns + 1, count=20) in LOST
    assert hand.controls.counts["inputs_old"] == 20


def test_an_input_that_has_seen_the_future_is_invalid() -> None:
    """An input that claims to have seen a message of the future is counted and not used."""
    hand = Hand()
    hand.give(OPEN)
    hand.give(HELD, age_ns=-1)
    assert hand.controls.counts["inputs_invalid"] == 1
    assert hand.controls.hand(hand.now_ns) == "open"


@pytest.mark.parametrize("name", ["steering", "throttle", "brake"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.0001, -1.0001, 1e308])
def test_numbers_out_of_range_are_rejected(name: str, value: float) -> None:
    """An input with a number that is not finite or out of range is counted and not used."""
    hand = Hand()
    hand.give(OPEN)
    hand.give(replace(HELD, **{name: value}))  # type: ignore[arg-type]
    assert hand.controls.counts["inputs_invalid"] == 1
    assert hand.controls.hand(hand.now_ns) == "open"


def test_inputs_without_a_page_are_not_used() -> None:
    """Without a driving page, no input opens the latch."""
    controls = HumanControls(wheelbase_m=2.8)
    controls.handle(replace(OPEN, seen_ns=START_NS), START_NS)
    controls.handle(replace(HELD, seen_ns=START_NS), START_NS)
    assert controls.hand(START_NS) == "no_page"
    assert controls.counts["inputs_without_control"] == 2


def test_without_an_input_the_decision_brakes() -> None:
    """Before the first input and after a loss, the decision has no throttle, full brake and a straight path."""
    hand = Hand()
    assert hand.controls.decide(5.0).brake == 1
    hand.give(OPEN)
    hand.give(replace(HELD, throttle=1.0, steering=1.0))
    assert hand.controls.decide(5.0).throttle == 1
    hand.controls.detach()
    decision = hand.controls.decide(5.0)
    assert (decision.throttle, decision.brake, decision.steering_rad) == (0, 1, 0)


def test_full_deflection_stays_within_the_lateral_limit() -> None:
    """At full deflection the lateral acceleration is the limit at any speed, unless the steering limit is smaller."""
    hand = Hand()
    hand.give(OPEN)
    hand.give(replace(HELD, steering=-1.0))
    assert hand.controls.decide(0.0).steering_rad == -HUMAN_LIMITS.steering_limit_rad
    fast = hand.controls.decide(10.0)
    assert 10.0**2 * math.tan(fast.steering_rad) / 2.8 == pytest.approx(-HUMAN_LIMITS.lateral_limit_mps2)
    assert fast.path_curvature_per_m == (math.tan(fast.steering_rad) / 2.8,) * 10


def test_no_throttle_above_the_speed_or_while_braking() -> None:
    """Above the target speed, and with the brake pressed, there is no throttle."""
    hand = Hand()
    hand.give(OPEN)
    hand.give(replace(HELD, throttle=0.5))
    assert hand.controls.decide(HUMAN_LIMITS.speed_mps - 0.1).throttle == 0.5
    assert hand.controls.decide(HUMAN_LIMITS.speed_mps).throttle == 0
    hand.give(replace(HELD, throttle=0.5, brake=0.1))
    assert hand.controls.decide(0.0).throttle == 0


numbers = st.floats() | st.sampled_from([0.0, 1.0, -1.0])
instants, flags = st.integers(0, START_NS + 10**10), st.booleans()
inputs = st.builds(HumanInput, instants, flags, flags, numbers, numbers, numbers)
events = st.tuples(st.integers(0, 400 * NS_PER_MS), st.sampled_from(["input", "attach", "detach"]), inputs, flags)


@given(st.lists(events, max_size=30))
def test_a_hold_always_follows_an_open_hand(steps: list[tuple[int, str, HumanInput, bool]]) -> None:
    """Whatever arrives, the hand is held only after a fresh and live input with an open hand since the last loss."""
    controls, now_ns, seen_open = HumanControls(wheelbase_m=2.8), START_NS, False
    for pause_ns, event, new, is_fresh in steps:
        now_ns += pause_ns
        was = controls.hand(now_ns)
        seen_open = seen_open and was not in LOST
        match event:
            case "attach":
                controls.attach(now_ns)
            case "detach":
                controls.detach()
            case _:
                controls.handle(replace(new, seen_ns=now_ns) if is_fresh else new, now_ns)
        hand = controls.hand(now_ns)
        seen_open = hand == "open" or (seen_open and hand not in LOST)
        assert hand != "held" or seen_open
        decision = controls.decide(8.0)
        assert abs(decision.steering_rad) <= HUMAN_LIMITS.steering_limit_rad
        assert 0 <= decision.throttle <= 1 and 0 <= decision.brake <= 1  # noqa: PT018
