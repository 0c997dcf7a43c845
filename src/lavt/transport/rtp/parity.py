"""Erasure code: two parity symbols, P and Q, from which any one or two missing symbols of a block are recovered.

It is the code of RAID 6, byte by byte over the field of 256 elements with the polynomial 0x11d (x^8 + x^4 + x^3 + x^2 +
1). P is the sum of all symbols, Q the sum of 2^i times symbol i, counted from 0. A sum is an exclusive or. Source:
H. P. Anvin, "The mathematics of RAID-6" (2004).
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
"""2^255 is 1 again: one more symbol would have the same factor in Q as the first symbol."""

_DOUBLED: Final = bytes(byte << 1 ^ (byte >> 7) * 0x11D for byte in range(256))
_TIMES: Final = list(accumulate(repeat(_DOUBLED, MAX_SYMBOLS - 1), bytes.translate, initial=bytes(range(256))))
"""At index i the table for `bytes.translate` that multiplies each byte by 2^i; at -i the table of the inverse."""
_EXPONENT: Final = {times[1]: exponent for exponent, times in enumerate(_TIMES)}
"""The exponent of each byte but 0, as a power of 2."""


def compute_parity(symbols: Sequence[bytes], count: int) -> list[bytes]:
    """Return the first `count` of P and Q, as long as the longest symbol; shorter symbols are padded with zeros.

    Raises `ValueError` for other than 1 to 255 symbols and 0 to 2 parity symbols.
    """
    if not 1 <= len(symbols) <= MAX_SYMBOLS or not 0 <= count <= len(_TERMS):
        raise ValueError(f"{count} parity symbols of {len(symbols)}: choose 0 to 2 of 1 to {MAX_SYMBOLS}")
    padded = _pad(symbols, max(map(len, symbols)))
    return [_sum(terms(padded)) for terms in _TERMS[:count]]


def recover(symbols: Sequence[bytes | None], parity_symbols: Mapping[int, bytes]) -> list[bytes]:
    """Return the symbols that are None, in order and with their padding of zeros.

    `parity_symbols` are the received parity symbols, with the keys `P` and `Q`, at least as many as symbols are
    missing. Raises `BadPacket` for fewer parity symbols, for more than 255 symbols, and for symbols longer than the
    parity symbols.
    """
    lost = [index for index, symbol in enumerate(symbols) if symbol is None]
    used = [parity for parity in (P, Q) if parity in parity_symbols][: len(lost)]
    if len(used) < len(lost) or len(symbols) > MAX_SYMBOLS:
        raise BadPacket("too few parity symbols, or too many symbols")
    if not used:
        return []
    known = [symbol or b"" for symbol in symbols]
    size = len(parity_symbols[used[0]])
    if len(parity_symbols[used[-1]]) != size or max(map(len, known)) > size:
        raise BadPacket("parity symbols shorter than another symbol")
    # Missing symbols are zeros here, so the known terms plus a parity symbol give the sum of the missing terms.
    padded = _pad(known, size)
    remainders = {parity: _sum([*_TERMS[parity](padded), parity_symbols[parity]]) for parity in used}
    first, last = lost[0], lost[-1]
    if len(lost) == 1:
        return [remainders[P] if P in remainders else remainders[Q].translate(_TIMES[-first])]
    # With the missing symbols a and b, P leaves a + b, and Q leaves 2^first a + 2^last b.
    # So 2^-first Q + P is (2^(last - first) + 1) b.
    mixed = _sum([remainders[Q].translate(_TIMES[-first]), remainders[P]])
    factor = _TIMES[last - first][1] ^ 1
    second = mixed.translate(_TIMES[-_EXPONENT[factor]])
    return [_sum([remainders[P], second]), second]


def _pad(symbols: Sequence[bytes], size: int) -> list[bytes]:
    """Return the symbols padded with zeros to one length."""
    return [symbol.ljust(size, b"\x00") for symbol in symbols]


def _sum(symbols: list[bytes]) -> bytes:
    """Return the sum of symbols of one length."""
    table = np.frombuffer(b"".join(symbols), np.uint8).reshape(len(symbols), len(symbols[0]))
    total: NDArray[np.uint8] = np.bitwise_xor.reduce(table)
    return total.tobytes()


def _terms_of_q(symbols: list[bytes]) -> list[bytes]:
    """Return each symbol multiplied by 2 to the power of its index."""
    return list(map(bytes.translate, symbols, _TIMES))


_TERMS: Final[tuple[Callable[[list[bytes]], list[bytes]], ...]] = (list, _terms_of_q)
"""The terms of the sums P and Q."""
