"""The controls of a person who drives: the dead-man's latch, the watchdog for old input, and the limits.

A person drives only while a hand holds the dead-man control. The latch begins locked. It opens when an input shows the
hand open (not holding); only a hold after that counts. It locks again if the page is hidden or has lost the focus, if
its inputs are old or missing, and if the page is gone: a control that was held before is not a decision to drive now.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Literal

from lavt.control.pure_pursuit import clamp, curvature_per_m
from lavt.domain import NS_PER_MS, PATH_POINTS, Decision

HandState = Literal["no_page", "not_seen", "not_live", "old_input", "no_input", "open", "held"]
"""no_page: no page drives. not_seen: the hand must be seen open first. not_live: the page is hidden or has no focus.
old_input, no_input: the inputs are old or missing. open: the hand is open. held: the hand holds the dead-man
control."""

LOST: frozenset[HandState] = frozenset({"no_page", "not_seen", "not_live", "old_input", "no_input"})
"""The states in which no command is made from the page."""


@dataclass(frozen=True, slots=True)
class HumanLimits:
    """The limits of a person's input, each with its unit and its reason."""

    input_timeout_ns: int = 200 * NS_PER_MS
    """Without an accepted input for this long, no command is made. A page sends an input every 20 ms."""
    input_age_ns: int = 200 * NS_PER_MS
    """An input that was made before the page had seen what was sent this long ago is dropped. The page gets a message
    at least every 50 ms."""
    lock_after_ns: int = 400 * NS_PER_MS
    """Without an accepted input for this long, or after an input of this age, the latch locks. Shorter pauses of a
    browser are common, and the vehicle bridges them: it stops after 500 ms without commands."""
    neutral_throttle: float = 0.05
    """Arming needs a throttle of at most this."""
    steering_limit_rad: float = 0.5
    """The largest road wheel angle."""
    lateral_limit_mps2: float = 3.0
    """The lateral acceleration at full deflection, if `steering_limit_rad` does not limit it. It is the vehicle's limit
    by default: a larger angle would be limited there."""
    speed_mps: float = 30 / 3.6
    """Above this speed there is no throttle."""


HUMAN_LIMITS = HumanLimits()


@dataclass(frozen=True, slots=True)
class HumanInput:
    """One input of a person: `steering` in [-1, 1], left positive, pedals in [0, 1]."""

    seen_ns: int
    """Send time, on this machine's monotonic clock, of the newest message that the page had seen."""
    is_held: bool
    """Whether the hand holds the dead-man control."""
    is_live: bool
    """Whether the page is visible and has the focus."""
    steering: float
    throttle: float
    brake: float


class HumanControls:
    """The newest valid input of the page that drives, and the state of the person's hand. It reads no clock."""

    def __init__(self, limits: HumanLimits = HUMAN_LIMITS, *, wheelbase_m: float) -> None:
        self.counts: Counter[str] = Counter()
        self._limits = limits
        self._wheelbase_m = wheelbase_m
        self._hand: HandState = "no_page"
        self._input: HumanInput | None = None
        self._input_ns = 0
        """When the newest valid input arrived; before the first one, when the page began to drive."""

    def attach(self, now_ns: int) -> None:
        """Begin to take input from a page; its hand has not been seen yet."""
        self._lock("not_seen")
        self._input_ns = now_ns

    def detach(self) -> None:
        """Take no more input: no page drives."""
        self._lock("no_page")

    def lock(self) -> None:
        """Lock the latch after a drive: a hold that lasts since then is no decision to drive again."""
        if self._hand != "no_page":
            self._lock("not_seen")

    def silent_ns(self, now_ns: int) -> int:
        """Return for how long no valid input has arrived from the page that drives."""
        return now_ns - self._input_ns

    def hand(self, now_ns: int) -> HandState:
        """Return the state of the hand; without an input for too long, the latch locks."""
        if self._hand == "no_page":
            return self._hand
        since_input_ns = now_ns - self._input_ns
        if since_input_ns >= self._limits.lock_after_ns:
            self._lock("no_input")
        return "no_input" if since_input_ns >= self._limits.input_timeout_ns else self._hand

    def handle(self, new: HumanInput, now_ns: int) -> None:
        """Process an input that arrived at `now_ns`; an invalid or old one is counted and changes only the latch."""
        if self.hand(now_ns) == "no_page":
            self.counts["inputs_without_control"] += 1
            return
        if not _is_valid(new) or new.seen_ns > now_ns:
            self.counts["inputs_invalid"] += 1
            return
        age_ns = now_ns - new.seen_ns
        if age_ns > self._limits.input_age_ns:
            self.counts["inputs_old"] += 1
            if age_ns > self._limits.lock_after_ns:
                self._lock("old_input")
            return
        self._input_ns = now_ns
        if not new.is_live:
            self._lock("not_live")
            return
        self._input = new
        if not new.is_held:
            self._hand = "open"
        elif self._hand == "open":
            self._hand = "held"

    @property
    def speed_mps(self) -> float:
        """Return the speed above which there is no throttle."""
        return self._limits.speed_mps

    @property
    def is_neutral(self) -> bool:
        """Return whether the throttle is released, as arming requires."""
        return self._input is None or self._input.throttle <= self._limits.neutral_throttle

    def decide(self, speed_mps: float) -> Decision:
        """Return the decision of the newest input within all limits; without an input, no throttle and full brake.

        At full deflection, the wheels turn as far as the lateral acceleration limit allows at this speed. The path
        ahead is the circle of the steering angle.
        """
        if self._input is None:
            return Decision(0.0, 0.0, 1.0, (0.0,) * PATH_POINTS)
        limits = self._limits
        lateral_rad = math.atan(self._wheelbase_m * limits.lateral_limit_mps2 / max(speed_mps, 1.0) ** 2)
        steering_rad = clamp(self._input.steering, 1.0) * min(limits.steering_limit_rad, lateral_rad)
        is_throttle_allowed = self._input.brake == 0 and speed_mps < limits.speed_mps
        return Decision(
            steering_rad=steering_rad,
            throttle=self._input.throttle if is_throttle_allowed else 0.0,
            brake=self._input.brake,
            path_curvature_per_m=(curvature_per_m(steering_rad, self._wheelbase_m),) * PATH_POINTS,
        )

    def _lock(self, hand: HandState) -> None:
        """Lock the latch, and drop the last input, so that no later command repeats it."""
        self._hand, self._input = hand, None


def _is_valid(new: HumanInput) -> bool:
    """Return whether all values are finite and in range."""
    return -1 <= new.steering <= 1 and 0 <= new.throttle <= 1 and 0 <= new.brake <= 1  # false for NaN
