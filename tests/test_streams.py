from __future__ import annotations

import pytest

from lavt.streams import IndexedStream, stream


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
