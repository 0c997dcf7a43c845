"""Erasure code: two parity symbols, P and Q, from which any one or two missing symbols of a block come back.

As in RAID 6, byte by byte over the field of 256 elements with the polynomial 0x11d (x^8 + x^4 + x^3 + x^2 + 1): P is
the sum of all symbols, Q that of 2^i times symbol i, counted from 0; a sum is an exclusive or. Source: H. P. Anvin,
"The mathematics of RAID-6" (2004).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, repeat
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lavt.errors import BadPacket

P: Final = 0
Q: Final = 1
MAX_SYMBOLS: Final = 255
"""2^255 is 1 again: one symbol more would go into Q as the first one does."""

_DOUBLED: Final = bytes(byte << 1 ^ (byte >> 7) * 0x11D for byte in range(256))
_TIMES: Final = list(accumulate(repeat(_DOUBLED, MAX_SYMBOLS - 1), bytes.translate, initial=bytes(range(256))))
"""At i what 2^i makes of each byte, for `bytes.translate`; at -i, as lists count from their end, what undoes that."""
_EXPONENT: Final = {times[1]: exponent for exponent, times in enumerate(_TIMES)}
"""Of each byte but 0, as a power of 2."""


def parity(symbols: Sequence[bytes], count: int) -> list[bytes]:
    """Make the first `count` of P and Q: bytes as many as the longest symbol has; shorter ones are filled with zeros.

    Raises `ValueError` for other than 1 to 255 symbols and 0 to 2 of parity.
    """
    if not 1 <= len(symbols) <= MAX_SYMBOLS or not 0 <= count <= len(_PARTS):
        raise ValueError(f"{count} parity symbols of {len(symbols)}: choose 0 to 2 of 1 to {MAX_SYMBOLS}")
    filled = _filled(symbols, max(map(len, symbols)))
    return [_sum(parts(filled)) for parts in _PARTS[:count]]


def missing(symbols: Sequence[bytes | None], parity_symbols: Mapping[int, bytes]) -> list[bytes]:
    """Make the symbols that are None, in order and with the zeros they were filled with.

    `parity_symbols` is what is there of `P` and `Q`: as many as are missing or more. Raises `BadPacket` for fewer, for
    more than 255 symbols, and for symbols longer than those of parity.
    """
    places = [place for place, symbol in enumerate(symbols) if symbol is None]
    used = [which for which in (P, Q) if which in parity_symbols][: len(places)]
    if len(used) < len(places) or len(symbols) > MAX_SYMBOLS:
        raise BadPacket("too few parity symbols, or too many others")
    if not used:
        return []
    known = [symbol or b"" for symbol in symbols]
    size = len(parity_symbols[used[0]])
    if len(parity_symbols[used[-1]]) != size or max(map(len, known)) > size:
        raise BadPacket("parity symbols shorter than another symbol")
    # What is missing is zeros here, so what these sums leave of parity is its parts alone.
    filled = _filled(known, size)
    left = {which: _sum([*_PARTS[which](filled), parity_symbols[which]]) for which in used}
    first, last = places[0], places[-1]
    if len(places) == 1:
        return [left[P] if P in left else left[Q].translate(_TIMES[-first])]
    # P leaves a + b, and Q 2^first a + 2^last b: so 2^-first Q + P is (2^(last - first) + 1) b.
    mixed = _sum([left[Q].translate(_TIMES[-first]), left[P]])
    factor = _TIMES[last - first][1] ^ 1
    second = mixed.translate(_TIMES[-_EXPONENT[factor]])
    return [_sum([left[P], second]), second]


def _filled(symbols: Sequence[bytes], size: int) -> list[bytes]:
    """Give symbols of one length."""
    return [symbol.ljust(size, b"\x00") for symbol in symbols]


def _sum(symbols: list[bytes]) -> bytes:
    """Add symbols of one length."""
    table = np.frombuffer(b"".join(symbols), np.uint8).reshape(len(symbols), len(symbols[0]))
    total: NDArray[np.uint8] = np.bitwise_xor.reduce(table)
    return total.tobytes()


def _parts_of_q(symbols: list[bytes]) -> list[bytes]:
    """Multiply each symbol by the power of 2 of its place."""
    return list(map(bytes.translate, symbols, _TIMES))


_PARTS: Final[tuple[Callable[[list[bytes]], list[bytes]], ...]] = (list, _parts_of_q)
"""What P and what Q are the sum of."""
