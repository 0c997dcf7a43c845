from __future__ import annotations

import numpy as np
import pytest

from lavt.streams import IndexedStream, QuantileStream, stream


@pytest.mark.parametrize("seed", [0, 7, 2**63 - 1])
def test_an_indexed_stream_equals_the_stream(seed: int) -> None:
    """An indexed stream returns the same values as `stream`, in any order and repeatedly."""
    entries = IndexedStream(seed, "video")
    for index in (5, 0, 2**32 - 1, 5, 2**64 - 1):
        generator = entries.at(index)
        expected = stream(seed, "video", index)
        assert generator.lognormal(0.0, 0.7) == expected.lognormal(0.0, 0.7)
        assert generator.integers(2**32, dtype="uint32") == expected.integers(2**32, dtype="uint32")
        assert generator.random(9).tolist() == expected.random(9).tolist()


LEVELS, VALUES = [0.0, 0.5, 0.95, 1.0], [100.0, 200.0, 500.0, 3000.0]


def test_a_quantile_stream_has_the_given_distribution() -> None:
    """The entries of a quantile stream have the given quantiles and never exceed the first and the last."""
    entries = QuantileStream(1, "cost", LEVELS, VALUES)
    drawn = [entries.at(index) for index in range(20_000)]
    assert min(drawn) >= 100
    assert max(drawn) <= 3000
    assert np.percentile(drawn, [50, 95]) == pytest.approx([200, 500], rel=0.05)
    assert abs(np.corrcoef(drawn[:-1], drawn[1:])[0, 1]) < 0.03


def test_an_entry_of_a_quantile_stream_depends_only_on_seed_name_and_index() -> None:
    """An entry is the same in whatever order entries are read; another seed or name gives other entries."""
    indices = [0, 127, 128, 2**40, 5]
    expected = [QuantileStream(1, "cost", LEVELS, VALUES).at(index) for index in indices]
    entries = QuantileStream(1, "cost", LEVELS, VALUES)
    assert [entries.at(index) for index in reversed(indices)] == expected[::-1]
    assert [QuantileStream(2, "cost", LEVELS, VALUES).at(index) for index in indices] != expected
    assert [QuantileStream(1, "link", LEVELS, VALUES).at(index) for index in indices] != expected


def test_a_quantile_stream_that_is_read_at_two_places_in_turns_draws_each_block_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Reading entries near 0 and near 10^6 in turns draws no block again."""
    drawn: list[int] = []
    at = IndexedStream.at

    def counted_at(self: IndexedStream, index: int) -> np.random.Generator:
        drawn.append(index)
        return at(self, index)

    monkeypatch.setattr(IndexedStream, "at", counted_at)
    entries = QuantileStream(1, "cost", LEVELS, VALUES)
    for index in range(1000):
        entries.at(index)
        entries.at(10**6 + index)
    assert len(drawn) == len(set(drawn))
