"""Tests of quantities that change linearly: time above a limit, stretches and percentiles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from lavt.experiment.compliance.ramps import EMPTY_RAMPS, Ramps, joined, longest

RAMPS = range(60)
"""Seeds of random quantities."""


def ramps_of(*pieces: tuple[float, float, float, float]) -> Ramps:
    """Return a quantity from pieces (begin, end, first, last)."""
    return Ramps(*(np.array(column, np.float64) for column in zip(*pieces, strict=True)))


def random_ramps(random: np.random.Generator) -> Ramps:
    """Return up to six pieces, some with gaps between them, some flat, some infinite."""
    time, pieces = 0.0, []
    for _ in range(random.integers(1, 7)):
        time += random.choice([0.0, 0.0, 2.0])
        length = float(random.integers(1, 6))
        first, last = random.choice([0.0, 1.0, 2.0, 3.0, 5.0, 6.0], 2)
        if random.random() < 0.1:
            first = last = np.inf
        pieces.append((time, time + length, first, last))
        time += length
    return ramps_of(*pieces)


SAWTOOTH = ramps_of((0, 10, 2, 12), (10, 20, 4, 14), (30, 40, 1, 1))


def test_time_and_stretches_of_a_sawtooth() -> None:
    """Time above, stretches and percentiles of two ramps and a flat piece are those computed by hand."""
    assert SAWTOOTH.duration == 30
    assert SAWTOOTH.maximum == 14
    assert [SAWTOOTH.time_above(limit) for limit in (0, 1, 3, 10, 14)] == [30, 20, 19, 6, 0]
    assert SAWTOOTH.stretches_above(3) == [(1, 20)]
    assert SAWTOOTH.stretches_above(10) == [(8, 10), (16, 20)]
    assert longest(SAWTOOTH.stretches_above(10)) == (16, 20)
    assert SAWTOOTH.stretches_above(14) == []
    assert longest([]) is None
    # Of 30: 10 at 1; 2 from 2 to 4; then two ramps share 16 from 4 to 12; 2 from 12 to 14.
    assert [SAWTOOTH.percentile(share) for share in (0.2, 11 / 30, 0.6, 29 / 30, 1.0)] == pytest.approx(
        [1, 3, 7, 13, 14]
    )


def test_without_pieces() -> None:
    """Without any time, there is no time above a limit, no maximum and no percentile."""
    assert EMPTY_RAMPS.time_above(1) == EMPTY_RAMPS.duration == 0
    assert EMPTY_RAMPS.maximum is EMPTY_RAMPS.percentile(0.5) is None
    assert EMPTY_RAMPS.stretches_above(1) == []
    assert len(EMPTY_RAMPS.split_at(np.array([1.0, 2.0])).begin) == 0
    assert joined([]) is EMPTY_RAMPS


def test_a_part_of_the_time() -> None:
    """Within intervals, only their time counts, and a stretch ends where an interval ends."""
    part = SAWTOOTH.within([(5, 8), (12, 35)])
    assert part.duration == 3 + 8 + 5
    assert part.first.tolist() == [7, 6, 1]
    assert part.last.tolist() == [10, 14, 1]
    assert part.stretches_above(0) == [(5, 8), (12, 20), (30, 35)]


def test_limits() -> None:
    """The share above is in 0 to 1, the longest stretch is at most the time above, and neither rises with the limit."""
    for seed in RAMPS:
        random = np.random.default_rng(seed)
        ramps, (limit, higher) = random_ramps(random), np.sort(random.choice([0, 0.5, 1, 2.25, 3, 4, 6, 7], 2))
        stretches = ramps.stretches_above(limit)
        above = ramps.time_above(limit)
        assert 0 <= above <= ramps.duration
        assert sum(end - begin for begin, end in stretches) == pytest.approx(above)
        assert all(first[1] < second[0] for first, second in pairwise(stretches))
        assert ramps.time_above(higher) <= above + 1e-9
        begin, end = longest(stretches) or (0.0, 0.0)
        higher_begin, higher_end = longest(ramps.stretches_above(higher)) or (0.0, 0.0)
        assert higher_end - higher_begin <= end - begin + 1e-9


def test_time_above_agrees_with_samples() -> None:
    """The time above a limit is that of many samples, to the error of sampling."""
    for seed in RAMPS:
        random = np.random.default_rng(seed)
        ramps, limit = random_ramps(random), random.uniform(0, 7)
        shares = (np.arange(1000) + 0.5) / 1000
        sampled = 0.0
        for begin, end, first, last in zip(ramps.begin, ramps.end, ramps.first, ramps.last, strict=True):
            values = np.full(1000, first) if first == last else first + (last - first) * shares
            sampled += (end - begin) * float(np.mean(values > limit))
        assert ramps.time_above(limit) == pytest.approx(sampled, abs=0.01 * len(ramps.begin))


def test_percentiles() -> None:
    """A percentile is exceeded for at most the rest of the time, and every smaller value for at least the rest."""
    for seed in RAMPS:
        random = np.random.default_rng(seed)
        ramps, share = random_ramps(random), random.uniform(0.01, 1.0)
        value = ramps.percentile(share)
        assert value is not None
        rest = (1 - share) * ramps.duration
        assert not np.isfinite(value) or ramps.time_above(value) <= rest + 1e-6
        smaller = value - 1e-6 if np.isfinite(value) else 1e9
        assert ramps.time_above(smaller) >= rest - 1e-6


def test_splitting_changes_nothing() -> None:
    """A quantity that is split at any times has the same time above, and the same stretches."""
    for seed in RAMPS:
        random = np.random.default_rng(seed)
        ramps, times, limit = random_ramps(random), random.uniform(-1, 40, 5), random.uniform(0, 7)
        split = ramps.split_at(times)
        assert split.duration == pytest.approx(ramps.duration)
        assert split.time_above(limit) == pytest.approx(ramps.time_above(limit), abs=1e-9)
        expected = [end - begin for begin, end in ramps.stretches_above(limit)]
        assert [end - begin for begin, end in split.stretches_above(limit)] == pytest.approx(expected, abs=1e-9)
