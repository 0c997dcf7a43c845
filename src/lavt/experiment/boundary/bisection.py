"""Where something begins as delay grows: a coarse grid first, then bisection; and where a measured rate passes zero."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scipy.optimize import brentq

NEAR_MS = 10.0
"""A guess is believed to be so good, at first."""
LARGEST_RATE_PER_S = 1.0
"""A rate beyond it is cut: it may be infinite, and how large it is says nothing of where it passes zero."""


@dataclass(frozen=True, slots=True)
class Bracket:
    """Two delays between which something begins; None where it has begun below the range, or begins beyond it."""

    low_ms: float | None
    high_ms: float | None
    monotone: bool = True
    """Whether it happened at every delay of the grid beyond the first at which it did."""


def first_bracket(happens: Callable[[float], bool], grid_ms: Sequence[float], within_ms: float) -> Bracket:
    """Find the first delays of the grid between which `happens` turns true, and bisect there to `within_ms`.

    `grid_ms` grows. What comes and goes between two delays of the grid is not seen. Both ends were asked.
    """
    happened = [happens(delay_ms) for delay_ms in grid_ms]
    if not any(happened):
        return Bracket(grid_ms[-1], None)
    first = happened.index(True)
    monotone = all(happened[first:])
    if first == 0:
        return Bracket(None, grid_ms[0], monotone)
    low_ms, high_ms = grid_ms[first - 1], grid_ms[first]
    while high_ms - low_ms > within_ms:
        middle_ms = (low_ms + high_ms) / 2
        if happens(middle_ms):
            high_ms = middle_ms
        else:
            low_ms = middle_ms
    return Bracket(low_ms, high_ms, monotone)


def zero_bracket(rate: Callable[[float], float], guess_ms: float, longest_ms: float, within_ms: float) -> Bracket:
    """Find where `rate` rises through 0 between delays of 0 and `longest_ms`, nearest to a guess, to `within_ms`.

    Looks `NEAR_MS` to both sides of the guess and farther out as long as the sign does not change; then Brent's method
    (`scipy.optimize.brentq`), which needs few values of a rate that is smooth. The zero is at most half of `within_ms`
    from what it gives: the ends are so far to both sides, cut to the range. `rate` was not asked there.
    """

    def cut(delay_ms: float) -> float:
        return min(max(rate(delay_ms), -LARGEST_RATE_PER_S), LARGEST_RATE_PER_S)

    low_ms = min(max(guess_ms - NEAR_MS, 0.0), longest_ms)
    high_ms = min(max(guess_ms + NEAR_MS, 0.0), longest_ms)
    step_ms = 2 * NEAR_MS
    while cut(low_ms) > 0:
        if low_ms == 0:
            return Bracket(None, 0.0)
        low_ms, high_ms, step_ms = max(low_ms - step_ms, 0.0), low_ms, 2 * step_ms
    while cut(high_ms) <= 0:
        if high_ms == longest_ms:
            return Bracket(longest_ms, None)
        low_ms, high_ms, step_ms = high_ms, min(high_ms + step_ms, longest_ms), 2 * step_ms
    half_ms = within_ms / 2
    root_ms = float(brentq(cut, low_ms, high_ms, xtol=half_ms))
    return Bracket(max(root_ms - half_ms, 0.0), min(root_ms + half_ms, longest_ms))
