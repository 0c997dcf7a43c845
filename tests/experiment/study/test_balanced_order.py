from __future__ import annotations

import itertools
from collections import Counter

import pytest

from lavt.experiment.study.balanced_order import order_of, orders_in_set, williams_design

SIZES = range(2, 9)


@pytest.mark.parametrize("size", SIZES)
def test_the_design_is_balanced(size: int) -> None:
    """Each condition has each position equally often, and directly follows each other condition equally often."""
    design = williams_design(size)
    times = len(design) // size
    assert times == 1 + size % 2
    for position in zip(*design, strict=True):
        assert Counter(position) == dict.fromkeys(range(size), times)
    follows = Counter(pair for row in design for pair in itertools.pairwise(row))
    assert follows == dict.fromkeys(itertools.permutations(range(size), 2), times)


def test_the_design_for_four_conditions() -> None:
    """The rows for four conditions are those of Williams's standard square."""
    assert williams_design(4) == ((0, 1, 3, 2), (1, 2, 0, 3), (2, 3, 1, 0), (3, 0, 2, 1))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("first", [1, 2])
def test_each_set_of_participants_is_balanced(size: int, first: int) -> None:
    """Each complete set of participants has all orders of the design, each once, under the labels of the seed."""
    conditions = "ABCDEFGH"[:size]
    count = orders_in_set(size)
    people = range((first - 1) * count + 1, first * count + 1)
    orders = {order_of(person, conditions, seed=7) for person in people}
    assert len(orders) == count
    follows = Counter(pair for order in orders for pair in itertools.pairwise(order))
    assert set(follows.values()) == {1 + size % 2}
    assert orders == {order_of(person, conditions, seed=7) for person in range(1, count + 1)}


def test_the_seed_determines_the_order() -> None:
    """Equal seeds give equal orders, and other seeds or sets another sequence of the orders."""
    people = range(1, 13)
    orders = {seed: [order_of(person, "ABCDEF", seed) for person in people] for seed in (1, 2)}
    assert orders[1] == [order_of(person, "ABCDEF", 1) for person in people] != orders[2]
    assert orders[1][:6] != orders[1][6:]
