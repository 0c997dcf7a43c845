"""Random processes of a link: numbers drawn by index from named streams, and netem's distributions of jitter.

Numbers are drawn in blocks, because a generator for each packet would cost 20 us. A distribution is a table of 4096
quantiles in standard deviations, like netem's tables (tc's `normal.dist`, `pareto.dist` and `paretonormal.dist`).
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
"""netem's tables contain 16-bit integers; 8192 is one standard deviation."""
PARETO_SHAPE: Final = 3.0

Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]


def uniform(generator: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Draw from [0, 1)."""
    return generator.random(count)


def normal(generator: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Draw from the standard normal distribution."""
    return generator.standard_normal(count)


class Draws:
    """A sequence of random numbers: one for each index of the stream `name` of `seed`, in any order of access."""

    def __init__(self, seed: int, name: str, draw: Draw = uniform) -> None:
        self._seed, self._name, self._draw = seed, name, draw
        self._block = -1
        self._values: list[float] = []

    def at(self, index: int) -> float:
        """Return the number of this index."""
        block = index // BLOCK
        if block != self._block:
            self._block = block
            self._values = self._draw(stream(self._seed, self._name, block), BLOCK).tolist()
        return self._values[index % BLOCK]


@lru_cache
def quantiles(distribution: Distribution) -> tuple[float, ...]:
    """Return one value for each of 4096 equally likely parts of a distribution, in netem's standard deviations.

    The value is the middle of the part; for `pareto` it is the lower end. `uniform` is in units of its half width.
    netem cuts `pareto` (shape 3) and `paretonormal` off at 4 standard deviations, so their true standard deviations are
    0.82 and 0.83, and their means -0.03.
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
    """A first-order Gauss-Markov process: a deviation that is correlated with the deviation one step before."""

    def __init__(self, seed: int, name: str, correlation: float) -> None:
        self._draws = Draws(seed, name, normal)
        self._correlation = correlation
        self._share = (1 - correlation**2) ** 0.5
        self._step = 0
        self._value = self._draws.at(0)

    def at(self, step: int) -> float:
        """Return the deviation at a step, in standard deviations; an earlier step returns the latest deviation."""
        while self._step < step:
            self._step += 1
            self._value = self._correlation * self._value + self._share * self._draws.at(self._step)
        return self._value


class LossProcess:
    """A loss process that is queried in order: independent losses, or bursts (Gilbert-Elliott model)."""

    def __init__(self, seed: int, name: str, loss: float, bursts: tuple[float, float] | None) -> None:
        self._draws = Draws(seed, name)
        self._loss, self._bursts = loss, bursts
        self._bad = False

    def is_lost(self, index: int) -> bool:
        """Return whether the packet with this number is lost."""
        drawn = self._draws.at(index)
        if self._bursts is None:
            return drawn < self._loss
        begins, ends = self._bursts
        lost = self._bad  # like the kernel: a packet's draw decides on the state of the next packet
        self._bad = drawn < (1 - ends if lost else begins)  # small draws lose in both states: a higher loss adds losses
        return lost
