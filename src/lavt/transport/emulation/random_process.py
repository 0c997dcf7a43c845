"""Random processes of a link: jitter with netem's distributions, and losses.

Random numbers are drawn in blocks, because making a generator for each packet would take 20 us. A distribution is a
table of 4096 quantiles in standard deviations, like netem's tables (tc's `normal.dist`, `pareto.dist` and
`paretonormal.dist`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lavt.streams import stream
from lavt.transport.emulation.impairment import BurstProbabilities, Distribution

NUMBERS_PER_BLOCK: Final = 256
QUANTILES: Final = 4096
LARGEST_QUANTILE: Final = 32767 / 8192
"""The largest value in netem's tables, which contain 16-bit integers; 8192 is one standard deviation."""
PARETO_SHAPE: Final = 3.0

Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]
"""A function `draw(generator, count)` that returns an array of `count` random numbers."""


def uniform(generator: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Draw from [0, 1)."""
    return generator.random(count)


def normal(generator: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Draw from the standard normal distribution."""
    return generator.standard_normal(count)


class Draws:
    """A random number for each index, from the random-number stream `name` of `seed`; indices can come in any order."""

    def __init__(self, seed: int, name: str, draw: Draw = uniform) -> None:
        self._seed, self._name, self._draw = seed, name, draw
        self._block = -1
        self._values: list[float] = []

    def at(self, index: int) -> float:
        """Return the number of this index."""
        block = index // NUMBERS_PER_BLOCK
        if block != self._block:
            self._block = block
            self._values = self._draw(stream(self._seed, self._name, block), NUMBERS_PER_BLOCK).tolist()
        return self._values[index % NUMBERS_PER_BLOCK]


@lru_cache
def quantiles(distribution: Distribution) -> tuple[float, ...]:
    """Return 4096 quantiles of a distribution, in units of the standard deviation that netem is given.

    The distribution is divided into 4096 equally likely parts. Each quantile is the middle of its part; for `pareto` it
    is the lower end. For `uniform` the unit is half of the distribution's width. netem's tables end at 4 standard
    deviations, which cuts off the tails of `pareto` (shape 3) and `paretonormal`. So the true standard deviations of
    these two are 0.82 and 0.83 instead of 1, and their means are -0.03 instead of 0.
    """
    if distribution == "uniform":
        return tuple((2 * part + 1) / QUANTILES - 1 for part in range(QUANTILES))
    normal_quantiles = _normal_quantiles()
    if distribution == "normal":
        return normal_quantiles
    pareto_quantiles = tuple(
        min(LARGEST_QUANTILE, ((1 - part / QUANTILES) ** (-1 / PARETO_SHAPE) - 1.5) * 4 / 3)
        for part in range(QUANTILES)
    )
    if distribution == "pareto":
        return pareto_quantiles
    pairs = zip(normal_quantiles, pareto_quantiles, strict=True)
    return tuple((normal_quantile + 3 * pareto_quantile) / 4 for normal_quantile, pareto_quantile in pairs)


def _normal_quantiles() -> tuple[float, ...]:
    standard = NormalDist()
    return tuple(standard.inv_cdf((part + 0.5) / QUANTILES) for part in range(QUANTILES))


class CorrelatedProcess:
    """A first-order Gauss-Markov process: a deviation that is correlated with the deviation one step before."""

    def __init__(self, seed: int, name: str, correlation: float) -> None:
        self._draws = Draws(seed, name, normal)
        self._correlation = correlation
        self._innovation_gain = (1 - correlation**2) ** 0.5
        self._step = 0
        self._value = self._draws.at(0)

    def at(self, step: int) -> float:
        """Return the deviation at `step` in standard deviations; for a past step, that of the newest step."""
        while self._step < step:
            self._step += 1
            innovation = self._innovation_gain * self._draws.at(self._step)
            self._value = self._correlation * self._value + innovation
        return self._value


class LossProcess:
    """Losses of packets: independent, or in bursts (Gilbert-Elliott model).

    `bursts` are the probabilities that a burst begins and ends; None: losses are independent, with probability `loss`.
    `name` is the name of the random-number stream of `seed`. Take two processes with the same stream and different
    loss. If both lose packets independently, the lossier process loses every packet that the other one loses, and more.
    The same holds for two processes with the same mean burst length b if the smaller loss is at most 1 - 1 / b. Above
    this limit a burst is less likely to continue than to begin, so that a draw can lose a packet outside of a burst
    only.
    """

    def __init__(self, seed: int, name: str, loss: float, bursts: BurstProbabilities | None) -> None:
        self._draws = Draws(seed, name)
        self._loss, self._bursts = loss, bursts
        self._in_burst = False

    def is_lost(self, index: int) -> bool:
        """Return whether the packet with this number is lost; the packets must be queried in order."""
        drawn = self._draws.at(index)
        if self._bursts is None:
            return drawn < self._loss
        is_lost = self._in_burst
        # As in the kernel, the draw of a packet decides whether the next one is lost. A small draw loses the next
        # packet, inside and outside of a burst.
        self._in_burst = drawn < (1 - self._bursts.end if is_lost else self._bursts.begin)
        return is_lost
