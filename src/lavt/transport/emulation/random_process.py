"""Chance on a link: numbers drawn by index from named streams, and netem's distributions of jitter.

Numbers are drawn in blocks, because a generator of its own for each packet would cost 20 us. A distribution is a table
of 4096 quantiles in standard deviations, as netem's are (tc's `normal.dist`, `pareto.dist` and `paretonormal.dist`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lavt.streams import stream
from lavt.transport.emulation.impairment import Distribution

BLOCK: Final = 256
QUANTILES: Final = 4096
LARGEST: Final = 32767 / 8192
"""netem's tables are 16-bit integers, and 8192 is one standard deviation."""
PARETO_SHAPE: Final = 3.0

Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]


def uniform(generator: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Draw from [0, 1)."""
    return generator.random(count)


def normal(generator: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Draw from the standard normal distribution."""
    return generator.standard_normal(count)


class Draws:
    """One number for each index of the stream `name` of `seed`, whatever the order in which they are asked for."""

    def __init__(self, seed: int, name: str, draw: Draw = uniform) -> None:
        self._seed, self._name, self._draw = seed, name, draw
        self._block = -1
        self._values: list[float] = []

    def at(self, index: int) -> float:
        """Give the number of an index."""
        block = index // BLOCK
        if block != self._block:
            self._block = block
            self._values = self._draw(stream(self._seed, self._name, block), BLOCK).tolist()
        return self._values[index % BLOCK]


@lru_cache
def quantiles(distribution: Distribution) -> tuple[float, ...]:
    """Give a value of each of 4096 equally likely parts of a distribution, in netem's standard deviations.

    It is the middle of the part and, of `pareto`, its lower end. That of `uniform` is its half width. netem's `pareto`
    (shape 3) and `paretonormal` are cut at 4 of them and so are not quite what they are called: their standard
    deviations are 0.82 and 0.83, their means -0.03.
    """
    if distribution == "uniform":
        return tuple((2 * part + 1) / QUANTILES - 1 for part in range(QUANTILES))
    bell = _normal()
    if distribution == "normal":
        return bell
    heavy = tuple(
        min(LARGEST, ((1 - part / QUANTILES) ** (-1 / PARETO_SHAPE) - 1.5) * 4 / 3) for part in range(QUANTILES)
    )
    if distribution == "pareto":
        return heavy
    return tuple((each + 3 * other) / 4 for each, other in zip(bell, heavy, strict=True))


def _normal() -> tuple[float, ...]:
    standard = NormalDist()
    return tuple(standard.inv_cdf((part + 0.5) / QUANTILES) for part in range(QUANTILES))


class CorrelatedProcess:
    """A deviation that is correlated with itself one step before, by step: Gauss and Markov's process, first order."""

    def __init__(self, seed: int, name: str, correlation: float) -> None:
        self._draws = Draws(seed, name, normal)
        self._correlation = correlation
        self._share = (1 - correlation**2) ** 0.5
        self._step = 0
        self._value = self._draws.at(0)

    def at(self, step: int) -> float:
        """Give the deviation at a step, in standard deviations; it never goes back."""
        while self._step < step:
            self._step += 1
            self._value = self._correlation * self._value + self._share * self._draws.at(self._step)
        return self._value


class LossProcess:
    """Which packets are lost, asked for in order: each by itself, or in bursts (Gilbert and Elliott's model)."""

    def __init__(self, seed: int, name: str, loss: float, bursts: tuple[float, float] | None) -> None:
        self._draws = Draws(seed, name)
        self._loss, self._bursts = loss, bursts
        self._bad = False

    def takes(self, index: int) -> bool:
        """Tell whether the packet with this number is lost."""
        drawn = self._draws.at(index)
        if self._bursts is None:
            return drawn < self._loss
        begins, ends = self._bursts
        lost = self._bad  # as the kernel has it: what is drawn at a packet counts from the next one
        self._bad = drawn < (1 - ends if lost else begins)  # small draws lose in either state: more loss adds to less
        return lost
