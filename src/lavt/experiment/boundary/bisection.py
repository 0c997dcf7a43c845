"""Searches over delay: for the onset of a criterion by grid and bisection, and for the zero of a measured rate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scipy.optimize import brentq

GUESS_ERROR_MS = 10.0
"""The first bracket around a guess reaches this far to both sides."""
LARGEST_RATE_PER_S = 1.0
"""Larger rates are clipped: they may be infinite, and their size is irrelevant for the zero crossing."""


@dataclass(frozen=True, slots=True)
class Bracket:
    """The two delays between which a criterion is first met; None at an end that is outside the searched range.

    `low_ms` is None where the criterion is met at the shortest delay, `high_ms` where it is met at no delay.
    """

    low_ms: float | None
    high_ms: float | None
    monotone: bool = True
    """True if the criterion is met at every delay of the grid from the first at which it is met."""


def first_bracket(criterion: Callable[[float], bool], grid_ms: Sequence[float], within_ms: float) -> Bracket:
    """Find the first step of the grid in which `criterion` turns true, and bisect it to a width of `within_ms`.

    `grid_ms` is ascending. A change that is reversed within one step of the grid is not found. The criterion was
    evaluated at both ends of the bracket.
    """
    is_met = [criterion(delay_ms) for delay_ms in grid_ms]
    if not any(is_met):
        return Bracket(grid_ms[-1], None)
    first = is_met.index(True)
    monotone = all(is_met[first:])
    if first == 0:
        return Bracket(None, grid_ms[0], monotone)
    low_ms, high_ms = grid_ms[first - 1], grid_ms[first]
    while high_ms - low_ms > within_ms:
        middle_ms = (low_ms + high_ms) / 2
        if criterion(middle_ms):
            high_ms = middle_ms
        else:
            low_ms = middle_ms
    return Bracket(low_ms, high_ms, monotone)


def zero_bracket(rate: Callable[[float], float], guess_ms: float, longest_ms: float, within_ms: float) -> Bracket:
    """Find the delay between 0 and `longest_ms` at which `rate` rises through 0, near a guess, to `within_ms`.

    The search starts `GUESS_ERROR_MS` to both sides of the guess and widens until the sign changes. Brent's method
    (`scipy.optimize.brentq`) then needs few values of a smooth rate. The ends of the bracket are half of `within_ms` to
    both sides of its root, clipped to the range; `rate` was not evaluated there.
    """

    def clipped(delay_ms: float) -> float:
        return min(max(rate(delay_ms), -LARGEST_RATE_PER_S), LARGEST_RATE_PER_S)

    low_ms = min(max(guess_ms - GUESS_ERROR_MS, 0.0), longest_ms)
    high_ms = min(max(guess_ms + GUESS_ERROR_MS, 0.0), longest_ms)
    step_ms = 2 * GUESS_ERROR_MS
    while clipped(low_ms) > 0:
        if low_ms == 0:
            return Bracket(None, 0.0)
        low_ms, high_ms, step_ms = max(low_ms - step_ms, 0.0), low_ms, 2 * step_ms
    while clipped(high_ms) <= 0:
        if high_ms == longest_ms:
            return Bracket(longest_ms, None)
        low_ms, high_ms, step_ms = high_ms, min(high_ms + step_ms, longest_ms), 2 * step_ms
    half_ms = within_ms / 2
    root_ms = float(brentq(clipped, low_ms, high_ms, xtol=half_ms))
    return Bracket(max(root_ms - half_ms, 0.0), min(root_ms + half_ms, longest_ms))
