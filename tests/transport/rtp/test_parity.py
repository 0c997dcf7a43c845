from __future__ import annotations

from collections.abc import Mapping, Sequence
from hashlib import shake_256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.errors import BadPacket
from lavt.transport.rtp.parity import P, Q, compute_parity, recover


def product(one: int, other: int) -> int:
    """Return the product of two bytes as polynomials over the field of two elements, modulo 0x11d, bit by bit."""
    total = 0
    for bit in range(8):
        if other >> bit & 1:
            total ^= one << bit
    for bit in range(14, 7, -1):
        if total >> bit & 1:
            total ^= 0x11D << (bit - 8)
    return total


def parity_by_definition(symbols: Sequence[bytes]) -> list[bytes]:
    """Return P and Q, computed byte by byte from their definition."""
    size = max(len(symbol) for symbol in symbols)
    p, q = bytearray(size), bytearray(size)
    power = 1
    for symbol in symbols:
        for index, byte in enumerate(symbol):
            p[index] ^= byte
            q[index] ^= product(power, byte)
        power = product(power, 2)
    return [bytes(p), bytes(q)]


def random_symbols(count: int, size: int) -> list[bytes]:
    """Return symbols of pseudorandom bytes, the same in each run."""
    random_bytes = shake_256(f"{count} {size}".encode()).digest(count * size)
    return [random_bytes[index * size :][:size] for index in range(count)]


def remove_symbols(symbols: Sequence[bytes], *indices: int) -> list[bytes | None]:
    """Return the symbols, with None in place of those at `indices`."""
    return [None if index in indices else symbol for index, symbol in enumerate(symbols)]


SYMBOLS_BY_HAND = [bytes.fromhex("01 80"), bytes.fromhex("80 ff"), bytes.fromhex("c0")]
P_BY_HAND = bytes.fromhex("41 7f")
"""01 + 80 + c0 and 80 + ff + 00."""
Q_BY_HAND = bytes.fromhex("3b 63")
"""2 * 80 = 100 - 11d = 1d; 2 * ff = 1fe - 11d = e3; 2 * c0 = 180 - 11d = 9d, 4 * c0 = 13a - 11d = 27.
01 + 1d + 27 and 80 + e3 + 00."""


def test_parity_by_hand() -> None:
    """P is the sum of all symbols i, and Q the sum of 2^i times symbol i, in the field with the polynomial 0x11d."""
    assert compute_parity(SYMBOLS_BY_HAND, 2) == [P_BY_HAND, Q_BY_HAND]
    assert compute_parity(SYMBOLS_BY_HAND, 1) == [P_BY_HAND]
    assert compute_parity(SYMBOLS_BY_HAND, 0) == []


@pytest.mark.parametrize(
    ("indices", "parities"),
    [
        ([1], {P: P_BY_HAND}),
        ([1], {Q: Q_BY_HAND}),
        ([2], {P: P_BY_HAND, Q: Q_BY_HAND}),
        ([0, 2], {P: P_BY_HAND, Q: Q_BY_HAND}),
        ([1, 2], {Q: Q_BY_HAND, P: P_BY_HAND}),
    ],
)
def test_recovery_by_hand(indices: list[int], parities: Mapping[int, bytes]) -> None:
    """Missing symbols are recovered in order, padded with zeros to the length of the parity symbols."""
    padded = [*SYMBOLS_BY_HAND[:2], bytes.fromhex("c0 00")]
    assert recover(remove_symbols(SYMBOLS_BY_HAND, *indices), parities) == [padded[index] for index in indices]


@given(st.lists(st.binary(max_size=40), min_size=1, max_size=40), st.data())
def test_any_missing_symbols_are_recovered(symbols: list[bytes], data: st.DataObject) -> None:
    """One or two missing symbols are recovered from at least as many parity symbols."""
    parities = compute_parity(symbols, 2)
    assert parities == parity_by_definition(symbols)
    lost = sorted(data.draw(st.sets(st.integers(0, len(symbols) - 1), min_size=1, max_size=2)))
    received = data.draw(st.sampled_from([[P, Q]] if len(lost) == 2 else [[P], [Q], [P, Q]]))
    padded = [symbol.ljust(len(parities[P]), b"\x00") for symbol in symbols]
    recovered = recover(remove_symbols(symbols, *lost), {parity: parities[parity] for parity in received})
    assert recovered == [padded[index] for index in lost]


@pytest.mark.parametrize("size", [1, 3])
def test_every_number_of_symbols(size: int) -> None:
    """P and Q of 1 to 255 symbols are those of the definition, and the first and last symbols are recovered."""
    for count in range(1, 256):
        symbols = random_symbols(count, size)
        p, q = compute_parity(symbols, 2)
        assert [p, q] == parity_by_definition(symbols)
        for index in {0, count // 2, count - 1}:
            assert recover(remove_symbols(symbols, index), {P: p}) == [symbols[index]]
            assert recover(remove_symbols(symbols, index), {Q: q}) == [symbols[index]]
        for first, second in {(0, count - 1), (0, 1), (count // 2, count - 1), (count - 2, count - 1)}:
            if 0 <= first < second < count:
                lost = remove_symbols(symbols, first, second)
                assert recover(lost, {P: p, Q: q}) == [symbols[first], symbols[second]]


def test_every_index() -> None:
    """Each of 255 symbols is recovered from Q alone, and two at any distance from P and Q."""
    symbols = random_symbols(255, 2)
    p, q = compute_parity(symbols, 2)
    for index in range(255):
        assert recover(remove_symbols(symbols, index), {Q: q}) == [symbols[index]]
    for distance in range(1, 255):
        first = distance * 7 % (255 - distance)
        lost = remove_symbols(symbols, first, first + distance)
        assert recover(lost, {P: p, Q: q}) == [symbols[first], symbols[first + distance]]


def test_empty_symbols() -> None:
    """Empty symbols have empty parity symbols."""
    assert compute_parity([b"", b""], 2) == [b"", b""]
    assert recover([None, b"", None], {P: b"", Q: b""}) == [b"", b""]


@pytest.mark.parametrize("parities", [{}, {P: b"p"}, {P: b"p", Q: b"q"}])
def test_nothing_missing(parities: Mapping[int, bytes]) -> None:
    """If no symbol is missing, none is recovered."""
    assert recover([b"a", b"b"], parities) == []


@pytest.mark.parametrize(("symbols", "count"), [(0, 1), (256, 1), (1, 3), (1, -1)])
def test_invalid_numbers_are_rejected(symbols: int, count: int) -> None:
    """No symbols, more than 255 symbols, and a number of parity symbols other than 0, 1 or 2 are rejected."""
    with pytest.raises(ValueError, match="choose 0 to 2 of 1 to 255"):
        compute_parity([b"x"] * symbols, count)


@pytest.mark.parametrize(
    ("symbols", "parities"),
    [
        ([b"a", None], {}),
        ([b"a", None], {2: b"r"}),
        ([b"a", None, None], {Q: b"q"}),
        ([None, None, None], {P: b"p", Q: b"q"}),
        ([b"a", None, None], {P: b"p", Q: b"qq"}),
        ([b"aa", None], {P: b"p"}),
        ([b"aa", None], {Q: b"q"}),
        ([b"a"] * 255 + [None], {P: b"p"}),
    ],
)
def test_invalid_symbols(symbols: list[bytes | None], parities: Mapping[int, bytes]) -> None:
    """Too few parity symbols, symbols longer than the parity symbols and over 255 symbols raise `BadPacket`."""
    with pytest.raises(BadPacket):
        recover(symbols, parities)


@given(
    st.lists(st.one_of(st.none(), st.binary(max_size=4)), max_size=8),
    st.dictionaries(st.integers(-1, 3), st.binary(max_size=4)),
)
def test_any_bytes(symbols: list[bytes | None], parities: dict[int, bytes]) -> None:
    """Any symbols and parity symbols give as many symbols as are missing or raise `BadPacket`."""
    try:
        recovered = recover(symbols, parities)
    except BadPacket:
        return
    assert len(recovered) == symbols.count(None)
