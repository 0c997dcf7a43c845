"""Named random-number streams, which are derived from one seed.

The entries of a stream have an index, such as a frame number or a packet number. Entry 17 of "video jitter" does not
depend on what else was drawn, and a new stream does not change the others. So runs with the same seed can be compared
in pairs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np


def stream_key(seed: int, name: str) -> int:
    """Return the 128-bit key of the stream `name` under `seed`: the first half of SHA-256 over both."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:16], "little")


def stream(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """Return the random generator of entry `index` of the stream `name`.

    Philox is counter-based: the index is the upper half of its counter, so that entries never overlap.
    """
    import numpy as np  # noqa: PLC0415 (large, and commands without random streams need none)

    return np.random.Generator(np.random.Philox(key=stream_key(seed, name), counter=(index & (2**64 - 1)) << 128))


class IndexedStream:
    """The stream `name` of `seed`, for reading many entries: `at` takes a tenth of the time of `stream`.

    The generator that `at` returns is valid until the next call of `at`.
    """

    def __init__(self, seed: int, name: str) -> None:
        import numpy as np  # noqa: PLC0415 (as above)

        self._bits = np.random.Philox(key=stream_key(seed, name))
        self._initial_state: Any = self._bits.state
        self._counter = self._initial_state["state"]["counter"]
        self._generator = np.random.Generator(self._bits)

    def at(self, index: int) -> np.random.Generator:
        """Return the same generator as `stream` for entry `index`."""
        self._counter[:] = (0, 0, index & (2**64 - 1), 0)
        self._bits.state = self._initial_state
        return self._generator


BLOCK_ENTRIES = 128
"""`QuantileStream` draws this many entries together, because a single draw takes almost as long as a block."""
KEPT_BLOCKS = 4
"""It keeps the last blocks, because a stage that is in two pipelines reads its stream at two places in turns."""


class QuantileStream:
    """The stream `name` of `seed` with entries from a distribution that is given by its quantiles.

    `values[i]` is the quantile at `levels[i]`; the levels grow from 0 to 1, and the quantile function is linear between
    them. Entries are independent of each other.
    """

    def __init__(self, seed: int, name: str, levels: Sequence[float], values: Sequence[float]) -> None:
        import numpy as np  # noqa: PLC0415 (as above)

        self._stream = IndexedStream(seed, name)
        self._levels, self._values = np.array(levels), np.array(values)
        self._blocks: dict[int, list[int]] = {}

    def at(self, index: int) -> int:
        """Return entry `index`, rounded to an integer; it does not depend on the entries that were read before."""
        block, position = divmod(index, BLOCK_ENTRIES)
        entries = self._blocks.get(block)
        if entries is None:
            import numpy as np  # noqa: PLC0415 (as above)

            levels = self._stream.at(block).random(BLOCK_ENTRIES)
            entries = np.rint(np.interp(levels, self._levels, self._values)).astype(np.int64).tolist()
            if len(self._blocks) == KEPT_BLOCKS:
                del self._blocks[next(iter(self._blocks))]
            self._blocks[block] = entries
        return entries[position]
