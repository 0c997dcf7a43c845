"""Searches for the shortest delay that meets a criterion, and for the delay at which a growth rate rises through zero.

The first search uses a grid and bisection, the second one Brent's method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scipy.optimize import brentq

GUESS_ERROR_MS = 10.0
"""`zero_bracket` begins its search at its guess plus and minus this much."""
LARGEST_RATE_PER_S = 1.0
"""Growth rates of oscillations are clipped to this size, because they can be infinite. The zero crossing does not
depend on their size."""


@dataclass(frozen=True, slots=True)
class Bracket:
    """The two delays between which the boundary lies.

    `low_ms` is None if the boundary is at the shortest delay or below it. `high_ms` is None if the
    boundary is above the longest delay of the search.
    """

    low_ms: float | None
    high_ms: float | None
    monotone: bool = True
    """False if a delay of the grid that is longer than the boundary does not meet the criterion."""


def first_bracket(criterion: Callable[[float], bool], grid_ms: Sequence[float], within_ms: float) -> Bracket:
    """Find the first interval of the grid in which `criterion` becomes true, and bisect it to a width of `within_ms`.

    `grid_ms` is ascending. If the criterion becomes true and false again between two delays of the grid, the search
    does not find this. The returned bracket begins and ends at delays for which the criterion was evaluated.
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


def zero_bracket(
    growth_rate: Callable[[float], float], guess_ms: float, longest_ms: float, within_ms: float
) -> Bracket:
    """Find the delay between 0 and `longest_ms` at which `growth_rate` rises through 0, to a width of `within_ms`.

    The search begins at the guess plus and minus `GUESS_ERROR_MS`, and moves outwards until the sign changes. Brent's
    method (`scipy.optimize.brentq`) then evaluates a smooth function at few delays only. The returned bracket is the
    root plus and minus half of `within_ms`, cut at 0 and `longest_ms`; `growth_rate` was not evaluated at its ends.
    """

    def clipped_rate(delay_ms: float) -> float:
        return min(max(growth_rate(delay_ms), -LARGEST_RATE_PER_S), LARGEST_RATE_PER_S)

    low_ms = min(max(guess_ms - GUESS_ERROR_MS, 0.0), longest_ms)
    high_ms = min(max(guess_ms + GUESS_ERROR_MS, 0.0), longest_ms)
    step_ms = 2 * GUESS_ERROR_MS
    while clipped_rate(low_ms) > 0:
        if low_ms == 0:
            return Bracket(None, 0.0)
        low_ms, high_ms, step_ms = max(low_ms - step_ms, 0.0), low_ms, 2 * step_ms
    while clipped_rate(high_ms) <= 0:
        if high_ms == longest_ms:
            return Bracket(longest_ms, None)
        low_ms, high_ms, step_ms = high_ms, min(high_ms + step_ms, longest_ms), 2 * step_ms
    half_ms = within_ms / 2
    root_ms = float(brentq(clipped_rate, low_ms, high_ms, xtol=half_ms))
    return Bracket(max(root_ms - half_ms, 0.0), min(root_ms + half_ms, longest_ms))
