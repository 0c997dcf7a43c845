"""Named random streams of one seed.

A stream is indexed by what its values belong to (a frame number, a packet number), so that value 17 of "video jitter"
is the same whatever else is drawn, and a new law leaves the others alone: runs with one seed stay paired.
"""

from __future__ import annotations

import hashlib

import numpy as np


def stream_key(seed: int, name: str) -> int:
    """128-bit key of the stream `name` under `seed`: the first half of SHA-256 over both."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:16], "little")


def stream(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """Random generator for entry `index` of the stream `name`.

    Philox is counter-based: the entry's index goes into the upper half of its counter, so that entries never overlap.
    """
    return np.random.Generator(np.random.Philox(key=stream_key(seed, name), counter=(index & (2**64 - 1)) << 128))
