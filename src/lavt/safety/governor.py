"""The speed governor: the highest speed that the measured picture age allows.

It runs on the vehicle, reads no clock and does no input or output. It uses nothing that a client states: only the times
on the server's monotonic clock at which pictures were captured and commands made from them were applied. So it acts in
the same way on a person, on a controller and on a hostile client.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.safety.speed_limit import SpeedLimit, lowest

NO_PICTURE = SpeedLimit(0.0, "no picture")


@dataclass(frozen=True, slots=True)
class GovernorSettings:
    """The settings of the speed governor; `docs/governor.md` has the formulas."""

    nominal_mps: float
    """The speed at which a picture age of `latency_limit_ns` is acceptable."""
    latency_limit_ns: int = 200 * NS_PER_MS
    sight_m: float = 20.0
    braking_mps2: float = 4.0
    brake_delay_ns: int = 200 * NS_PER_MS
    """The vehicle's own delay between a command to brake and the deceleration."""
    reaction_ns: int = 0
    """The reaction time of a person, which is not part of the picture age."""
    delay_margin: tuple[tuple[float, int], ...] = ()
    """(speed in m/s, tolerated delay in ns) with growing speeds and delays that do not grow; empty: no limit."""
    window_ns: int = 5 * NS_PER_S
    tail: float = 0.95
    """The quantile of the picture ages in the window, 0 to 1; 1 is their maximum."""
    rise_mps2: float = 0.5
    hysteresis_mps: float = 0.5

    def sight_limit_mps(self, age_s: float) -> float:
        """Return the highest speed v with v x (age + own delays) + v^2 / (2 x braking) <= sight distance."""
        blind_s = age_s + (self.brake_delay_ns + self.reaction_ns) / NS_PER_S
        return 2 * self.sight_m / (blind_s + math.sqrt(blind_s * blind_s + 2 * self.sight_m / self.braking_mps2))

    def latency_limit_mps(self, age_s: float) -> float:
        """Return the speed at which the way driven in `age_s` is nominal speed x latency limit; below it, infinity."""
        limit_s = self.latency_limit_ns / NS_PER_S
        return self.nominal_mps * limit_s / age_s if age_s > limit_s else math.inf

    def delay_margin_mps(self, age_s: float) -> float:
        """Return the highest speed of the table whose delay is at least `age_s`, or 0; infinity without a table."""
        if not self.delay_margin:
            return math.inf
        return max((mps for mps, delay_ns in self.delay_margin if age_s <= delay_ns / NS_PER_S), default=0.0)


class Governor:
    """A speed limit that falls at once when the picture age grows, and rises slowly when it shrinks.

    The picture in force is the one from which the last accepted command was made. Its age grows until a command from a
    picture that is newer than all before replaces it; until then, a command from an older picture makes it older. Two
    ages count: the present one of the picture in force, and the quantile `tail` of the largest ages that the pictures
    of the last `window_ns` reached.
    """

    def __init__(self, settings: GovernorSettings, speed_limit_mps: float) -> None:
        self.settings = settings
        self._speed_limit = SpeedLimit(speed_limit_mps, "speed")
        self._limit = NO_PICTURE
        self._is_rising = False
        self._noted_ns: int | None = None
        """When the last newer picture came into force."""
        self._captured_ns: float | None = None
        """Capture time of the picture in force; None: unknown."""
        self._ages: deque[tuple[int, float]] = deque()
        """Time of replacement, and largest age, of each picture of the window; oldest first."""
        self._sorted_ages_ns: list[float] = []

    def note_age(self, age_ns: float, now_ns: int, *, is_newer: bool = True) -> None:
        """Note the age, at `now_ns`, of the picture from which an accepted command was made.

        `is_newer` tells whether the picture is newer than those of all earlier commands. Only such a picture makes the
        age smaller; another makes it larger if it is older than the one in force. A picture that was captured at the
        same time changes nothing. After a negative age, or one that is not finite, no picture is in force.
        """
        self.limit(now_ns)  # for the largest age of the picture that is replaced
        if not 0 <= age_ns < math.inf:
            self._captured_ns = None
            return
        captured_ns, replaced_ns = now_ns - age_ns, self._captured_ns
        if replaced_ns is not None and (captured_ns == replaced_ns or not is_newer):
            self._captured_ns = min(captured_ns, replaced_ns)
            self.limit(now_ns)
            return
        if replaced_ns is not None:
            self._ages.append((now_ns, now_ns - replaced_ns))
            insort(self._sorted_ages_ns, now_ns - replaced_ns)
        self._captured_ns = captured_ns
        self._raise(now_ns)

    def begin_arming(self) -> None:
        """Forget the picture in force, because nobody drove by it meanwhile; the ages of the window remain."""
        self._captured_ns = None

    def begin_drive(self, now_ns: int) -> None:
        """Set the limit to what the present age allows: the vehicle is stationary, and has ages of its arming."""
        self._limit, self._is_rising, self._noted_ns = self.allowed(now_ns), False, now_ns

    def limit(self, now_ns: int) -> SpeedLimit:
        """Return the limit for now, which is never above `allowed`: between newer pictures it only falls."""
        allowed, limit_mps = self.allowed(now_ns), self._limit.mps
        if allowed.mps <= limit_mps:
            self._limit, self._is_rising = allowed, False
        elif self._is_rising or allowed.mps - limit_mps >= self.settings.hysteresis_mps:
            self._limit = SpeedLimit(limit_mps, "recovery")
        else:
            self._limit = SpeedLimit(limit_mps, allowed.reason)
        return self._limit

    def _raise(self, now_ns: int) -> None:
        """Raise the limit, by at most `rise_mps2`, because a newer picture is in force.

        It begins to rise when `allowed` is higher by the hysteresis, and then rises until it has reached it.
        """
        last_ns = now_ns if self._noted_ns is None else self._noted_ns
        self._noted_ns = max(now_ns, last_ns)
        allowed, limit_mps = self.allowed(now_ns), self._limit.mps
        if self._is_rising or allowed.mps - limit_mps >= self.settings.hysteresis_mps:
            raised_mps = limit_mps + self.settings.rise_mps2 * max(0, now_ns - last_ns) / NS_PER_S
            self._is_rising = raised_mps < allowed.mps
            self._limit = SpeedLimit(raised_mps, "recovery") if self._is_rising else allowed

    def allowed(self, now_ns: int) -> SpeedLimit:
        """Return the highest speed that the present ages allow, without slow rise and hysteresis.

        Sight and latency limit the speed by the larger age. The delay margin does so by the quantile alone: one late
        picture does not make a loop unstable.
        """
        ages = self._ages_s(now_ns)
        if ages is None:
            return NO_PICTURE
        present_s, tail_s = ages
        age_s, settings = max(present_s, tail_s), self.settings
        return lowest(
            self._speed_limit,
            SpeedLimit(settings.sight_limit_mps(age_s), "sight"),
            SpeedLimit(settings.latency_limit_mps(age_s), "latency"),
            SpeedLimit(settings.delay_margin_mps(tail_s), "delay margin"),
        )

    def age_s(self, now_ns: int) -> float | None:
        """Return the larger one of the two ages, in seconds; None if no picture is in force."""
        ages = self._ages_s(now_ns)
        return None if ages is None else max(ages)

    def _ages_s(self, now_ns: int) -> tuple[float, float] | None:
        """Return the present age of the picture in force, and the quantile; None if no picture is in force.

        Without an age in the window, the quantile is the present age.
        """
        if self._captured_ns is None:
            return None
        ages, sorted_ages_ns = self._ages, self._sorted_ages_ns
        while ages and ages[0][0] < now_ns - self.settings.window_ns:
            _, expired_ns = ages.popleft()
            del sorted_ages_ns[bisect_left(sorted_ages_ns, expired_ns)]
        present_s = max(0.0, now_ns - self._captured_ns) / NS_PER_S
        if not sorted_ages_ns:
            return present_s, present_s
        rank = max(0, math.ceil(self.settings.tail * len(sorted_ages_ns)) - 1)
        return present_s, sorted_ages_ns[rank] / NS_PER_S
