from __future__ import annotations

from collections.abc import Mapping, Sequence
from hashlib import shake_256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.errors import BadPacket
from lavt.transport.rtp.parity import P, Q, missing, parity


def product(one: int, other: int) -> int:
    """Of two bytes as polynomials over the field of two elements, modulo 0x11d: by hand, one bit after the other."""
    total = 0
    for bit in range(8):
        if other >> bit & 1:
            total ^= one << bit
    for bit in range(14, 7, -1):
        if total >> bit & 1:
            total ^= 0x11D << (bit - 8)
    return total


def slow_parity(symbols: Sequence[bytes]) -> list[bytes]:
    """P and Q as their definition says."""
    size = max(len(symbol) for symbol in symbols)
    p, q = bytearray(size), bytearray(size)
    power = 1
    for symbol in symbols:
        for place, byte in enumerate(symbol):
            p[place] ^= byte
            q[place] ^= product(power, byte)
        power = product(power, 2)
    return [bytes(p), bytes(q)]


def some(count: int, size: int) -> list[bytes]:
    """Symbols of any bytes, the same in each run."""
    drawn = shake_256(f"{count} {size}".encode()).digest(count * size)
    return [drawn[place * size :][:size] for place in range(count)]


def without(symbols: Sequence[bytes], *places: int) -> list[bytes | None]:
    return [None if place in places else symbol for place, symbol in enumerate(symbols)]


BY_HAND = [bytes.fromhex("01 80"), bytes.fromhex("80 ff"), bytes.fromhex("c0")]
P_BY_HAND = bytes.fromhex("41 7f")
"""01 + 80 + c0 and 80 + ff + 00."""
Q_BY_HAND = bytes.fromhex("3b 63")
"""2 * 80 = 100 - 11d = 1d; 2 * ff = 1fe - 11d = e3; 2 * c0 = 180 - 11d = 9d, 4 * c0 = 13a - 11d = 27.
01 + 1d + 27 and 80 + e3 + 00."""


def test_parity_by_hand() -> None:
    """P is the sum of the symbols and Q that of 2^i times symbol i, over the polynomial 0x11d."""
    assert parity(BY_HAND, 2) == [P_BY_HAND, Q_BY_HAND]
    assert parity(BY_HAND, 1) == [P_BY_HAND]
    assert parity(BY_HAND, 0) == []


@pytest.mark.parametrize(
    ("places", "parities"),
    [
        ([1], {P: P_BY_HAND}),
        ([1], {Q: Q_BY_HAND}),
        ([2], {P: P_BY_HAND, Q: Q_BY_HAND}),
        ([0, 2], {P: P_BY_HAND, Q: Q_BY_HAND}),
        ([1, 2], {Q: Q_BY_HAND, P: P_BY_HAND}),
    ],
)
def test_missing_by_hand(places: list[int], parities: Mapping[int, bytes]) -> None:
    """What is missing comes back in order, filled with zeros to the length of the parity symbols."""
    filled = [*BY_HAND[:2], bytes.fromhex("c0 00")]
    assert missing(without(BY_HAND, *places), parities) == [filled[place] for place in places]


@given(st.lists(st.binary(max_size=40), min_size=1, max_size=40), st.data())
def test_any_missing(symbols: list[bytes], data: st.DataObject) -> None:
    """Any one or two missing of any symbols come back from any parity symbols that are as many or more."""
    made = parity(symbols, 2)
    assert made == slow_parity(symbols)
    places = sorted(data.draw(st.sets(st.integers(0, len(symbols) - 1), min_size=1, max_size=2)))
    there = data.draw(st.sampled_from([[P, Q]] if len(places) == 2 else [[P], [Q], [P, Q]]))
    filled = [symbol.ljust(len(made[P]), b"\x00") for symbol in symbols]
    assert missing(without(symbols, *places), {which: made[which] for which in there}) == [filled[at] for at in places]


@pytest.mark.parametrize("size", [1, 3])
def test_every_count(size: int) -> None:
    """From 1 to 255 symbols P and Q are those of the definition, and make the first and last ones again."""
    for count in range(1, 256):
        symbols = some(count, size)
        p, q = parity(symbols, 2)
        assert [p, q] == slow_parity(symbols)
        for place in {0, count // 2, count - 1}:
            assert missing(without(symbols, place), {P: p}) == [symbols[place]]
            assert missing(without(symbols, place), {Q: q}) == [symbols[place]]
        for first, second in {(0, count - 1), (0, 1), (count // 2, count - 1), (count - 2, count - 1)}:
            if 0 <= first < second < count:
                lost = without(symbols, first, second)
                assert missing(lost, {P: p, Q: q}) == [symbols[first], symbols[second]]


def test_every_place() -> None:
    """Of 255 symbols each comes back from Q alone, and any two whatever lies between them."""
    symbols = some(255, 2)
    p, q = parity(symbols, 2)
    for place in range(255):
        assert missing(without(symbols, place), {Q: q}) == [symbols[place]]
    for apart in range(1, 255):
        first = apart * 7 % (255 - apart)
        lost = without(symbols, first, first + apart)
        assert missing(lost, {P: p, Q: q}) == [symbols[first], symbols[first + apart]]


def test_empty_symbols() -> None:
    """Symbols without bytes have parity without bytes."""
    assert parity([b"", b""], 2) == [b"", b""]
    assert missing([None, b"", None], {P: b"", Q: b""}) == [b"", b""]


@pytest.mark.parametrize("parities", [{}, {P: b"p"}, {P: b"p", Q: b"q"}])
def test_nothing_missing(parities: Mapping[int, bytes]) -> None:
    """Where nothing is missing nothing is made."""
    assert missing([b"a", b"b"], parities) == []


@pytest.mark.parametrize(("symbols", "count"), [(0, 1), (256, 1), (1, 3), (1, -1)])
def test_no_parity(symbols: int, count: int) -> None:
    """Parity of no symbols or of more than 255, and other than P and Q, is refused."""
    with pytest.raises(ValueError, match="choose 0 to 2 of 1 to 255"):
        parity([b"x"] * symbols, count)


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
def test_cannot_be(symbols: list[bytes | None], parities: Mapping[int, bytes]) -> None:
    """More missing than there is parity, symbols longer than it and more than 255 of them are a bad packet."""
    with pytest.raises(BadPacket):
        missing(symbols, parities)


@given(
    st.lists(st.one_of(st.none(), st.binary(max_size=4)), max_size=8),
    st.dictionaries(st.integers(-1, 3), st.binary(max_size=4)),
)
def test_any_bytes(symbols: list[bytes | None], parities: dict[int, bytes]) -> None:
    """Whatever is taken for symbols and parity gives as many symbols as are missing or is a bad packet."""
    try:
        made = missing(symbols, parities)
    except BadPacket:
        return
    assert len(made) == symbols.count(None)
