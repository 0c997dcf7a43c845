"""Named random streams of one seed.

A stream is indexed by what its values belong to (a frame number, a packet number), so that value 17 of "video jitter"
is the same whatever else is drawn, and a new law leaves the others alone: runs with one seed stay paired.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np


def stream_key(seed: int, name: str) -> int:
    """128-bit key of the stream `name` under `seed`: the first half of SHA-256 over both."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:16], "little")


def stream(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """Random generator for entry `index` of the stream `name`.

    Philox is counter-based: the entry's index goes into the upper half of its counter, so that entries never overlap.
    """
    return np.random.Generator(np.random.Philox(key=stream_key(seed, name), counter=(index & (2**64 - 1)) << 128))


class IndexedStream:
    """The stream `name` of `seed`, for who asks for one entry after the other: as `stream`, in a tenth of the time.

    The generator that `at` gives is good until the next call.
    """

    def __init__(self, seed: int, name: str) -> None:
        self._bits = np.random.Philox(key=stream_key(seed, name))
        self._begin: Any = self._bits.state
        self._counter = self._begin["state"]["counter"]
        self._generator = np.random.Generator(self._bits)

    def at(self, index: int) -> np.random.Generator:
        """Give the generator at entry `index`."""
        self._counter[:] = (0, 0, index & (2**64 - 1), 0)
        self._bits.state = self._begin
        return self._generator
