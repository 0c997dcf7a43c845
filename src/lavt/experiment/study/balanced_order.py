"""The order of the conditions for each participant: a balanced Latin square, randomised by a seed.

The design is that of E. J. Williams (Experimental Designs Balanced for the Estimation of Residual Effects of
Treatments, Australian Journal of Scientific Research A 2, 1949). Over a complete set of orders, every condition has
every position equally often, and every condition directly follows every other condition equally often.
"""

from __future__ import annotations

from collections.abc import Sequence

from lavt.streams import stream

STREAM = "study order"


def williams_design(size: int) -> tuple[tuple[int, ...], ...]:
    """Return the orders of the numbers 0 to `size` - 1: one square for an even size, and two for an odd size.

    In one square, each number directly follows each other number once; an odd size needs two squares, where it does so
    twice. The second square has the rows of the first in reverse.
    """
    first = [0] + [(number + 1) // 2 if number % 2 else size - number // 2 for number in range(1, size)]
    square = tuple(tuple((number + shift) % size for number in first) for shift in range(size))
    return square if size % 2 == 0 else square + tuple(row[::-1] for row in square)


def order_of(participant: int, conditions: Sequence[str], seed: int) -> tuple[str, ...]:
    """Return the conditions in the order for the participant with this number, which begins with 1.

    Each complete set of consecutive participants (`orders_in_set`) gets all orders of the design. The seed determines
    which condition is which number of the design, and in which sequence each set of participants gets the orders.
    """
    design = williams_design(len(conditions))
    set_number, place = divmod(participant - 1, len(design))
    labels = stream(seed, f"{STREAM}: conditions").permutation(len(conditions))
    row = design[int(stream(seed, f"{STREAM}: rows", set_number).permutation(len(design))[place])]
    return tuple(conditions[int(labels[number])] for number in row)


def orders_in_set(conditions: int) -> int:
    """Return the number of orders in the design for so many conditions; the number of participants is best a multiple.

    Otherwise some orders are driven by one participant more than others.
    """
    return len(williams_design(conditions))
