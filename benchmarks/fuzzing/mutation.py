"""Make inputs by mutations of valid inputs; the seed determines all of them."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

import msgpack
import numpy as np

from lavt.streams import stream

MAX_NOISE_BYTES = 1500
MAX_MUTATIONS_PER_INPUT = 3

SMALL_INTEGERS: Final = (0, 1, -1, 2, 127, 128, 255, 256, 65_535, 65_536)
LARGE_INTEGERS: Final = (2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**62, 2**62 + 1, 2**63 - 1, 2**63, 2**64 - 1)
INTEGERS: Final = (*SMALL_INTEGERS, *LARGE_INTEGERS, -(2**31), -(2**63))
FINITE: Final = (0.0, -0.0, 0.1, 1.0, -1.0, 1.0000001, 100.0, 1e308, -1e308, 5e-324)
NUMBERS: Final = (*FINITE, float("inf"), -float("inf"), float("nan"))
TEXTS: Final = (
    "",
    "a",
    "arm",
    "drive",
    "stop",
    "acquire",
    "request_handover",
    "release",
    "emergency_stop",
    "clear_emergency_stop",
    "driving",
    "arming",
    "degraded",
    "safe_stop",
    "disarmed",
    "park",
    "reverse",
    "pareto",
    "uniform",
    "**",
    "lavt/**",
    "\x00",
    "x" * 33,
    "x" * 200,
    "x" * 201,
    "é" * 100,
    "\U0001f697" * 50,
    "1e5",
    "None",
)
OTHER_VALUES: Final[tuple[Any, ...]] = (
    None,
    True,
    False,
    b"",
    bytes(16),
    bytes(32),
    b"\xff\xfe",
    bytes(300),
    [],
    [0] * 10,
    [float("nan")] * 10,
    [1.0] * 9 + [float("inf")],
    ["x"] * 10,
    [[[[]]]],
    {},
    {"a": 1},
    {1: 2},
    msgpack.ExtType(5, b"x"),
    msgpack.Timestamp(0),
)
VALUES: Final[tuple[Any, ...]] = (*INTEGERS, *NUMBERS, *TEXTS, *OTHER_VALUES)

BOMBS: Final = (
    b"\xdd\xff\xff\xff\xff",
    b"\xdf\xff\xff\xff\xff",
    b"\xdb\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff",
    b"\x91" * 1000,
    b"\x81" * 1000,
    b"\xc7\xff\x01",
    b"\xc1",
    b"\xd8\xff",
    b"",
)
"""Prefixes of msgpack that are invalid, announce more data than follows, or nest deeper than any message."""

JSON_BOMBS: Final = (b"[" * 5000, b'{"a":' * 5000, b"9" * 5000, b'"', b"\\ud800", b"\x00", b"\xef\xbb\xbf")
"""Prefixes of JSON that are invalid, nest deeper than any message, or are longer than any."""

Item = TypeVar("Item")


class Chance:
    """Random numbers of a named random-number stream.

    Thousands of numbers are drawn at once, because drawing each one alone would take longer than parsing an input.
    """

    def __init__(self, seed: int, name: str) -> None:
        self._generator = stream(seed, f"fuzz {name}")
        self._next = _numbers(self._generator).__next__

    def below(self, bound: int) -> int:
        """Return an integer in [0, bound)."""
        return self._next() % bound

    def choice(self, items: Sequence[Item]) -> Item:
        """Return one of the items."""
        return items[self._next() % len(items)]

    def bytes(self, length: int) -> bytes:
        """Return random bytes."""
        return self._generator.bytes(length)


def _numbers(generator: np.random.Generator) -> Iterator[int]:
    while True:
        yield from generator.integers(0, 2**32, size=8192).tolist()


@dataclass
class Corpus:
    """The valid inputs of one channel, from which inputs are made."""

    entries: Sequence[bytes]
    """Valid inputs, which are mutated."""
    fields: Sequence[tuple[int, int]] = ()
    """Offset and length (bytes) of each field, if the inputs have a binary layout."""
    packed: bool = False
    """Whether the inputs are msgpack arrays, in which single values are replaced."""
    is_json: bool = False
    """Whether the inputs are JSON objects, in which single values are replaced."""
    replays: deque[bytes] = field(default_factory=lambda: deque(maxlen=64))
    """Earlier true inputs, which are repeated without changes."""


Mutation = Callable[[bytes, Corpus, Chance], bytes]


def next_input(corpus: Corpus, chance: Chance) -> bytes:
    """Return the next input: noise (1 of 16), a replay (2 of 16), or a valid input with up to three mutations."""
    kind = chance.below(16)
    if kind == 0:
        return chance.bytes(chance.below(MAX_NOISE_BYTES))
    if kind <= 2 and corpus.replays:
        return chance.choice(corpus.replays)
    data = chance.choice(corpus.entries)
    mutations = _mutations_of(corpus)
    for _ in range(chance.below(MAX_MUTATIONS_PER_INPUT + 1)):
        data = chance.choice(mutations)(data, corpus, chance)
    return data


def _mutations_of(corpus: Corpus) -> tuple[Mutation, ...]:
    if corpus.packed:
        return PACKED_MUTATIONS
    if corpus.is_json:
        return JSON_MUTATIONS
    return BINARY_MUTATIONS if corpus.fields else UNSTRUCTURED_MUTATIONS


def _flip(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    if not data:
        return data
    changed = bytearray(data)
    for _ in range(1 + chance.below(8)):
        changed[chance.below(len(changed))] ^= 1 << chance.below(8)
    return bytes(changed)


def _truncate(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    return data[: chance.below(len(data) + 1)]


def _lengthen(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    return data + chance.bytes(chance.below(64))


def _splice(data: bytes, corpus: Corpus, chance: Chance) -> bytes:
    other = chance.choice(corpus.entries)
    return data[: chance.below(len(data) + 1)] + other[chance.below(len(other) + 1) :]


def _overwrite(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    offset, length = chance.below(len(data) + 1), 1 + chance.below(8)
    repeated_byte = chance.choice((b"\x00", b"\xff", b"\x7f", b"\x80")) * length
    return data[:offset] + (repeated_byte if chance.below(2) else chance.bytes(length)) + data[offset + length :]


def _remove(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    offset = chance.below(len(data) + 1)
    return data[:offset] + data[offset + 1 + chance.below(16) :]


def _change_field(data: bytes, corpus: Corpus, chance: Chance) -> bytes:
    """Replace the value of a field by a near or a far value."""
    offset, length = chance.choice(corpus.fields)
    if offset + length > len(data):
        return data
    old, mask = int.from_bytes(data[offset : offset + length], "big"), (1 << 8 * length) - 1
    small, half = chance.below(32), 1 << (8 * length - 1)
    new: int = chance.choice((old + small, old - small, old + half, half, mask, chance.choice(INTEGERS)))
    return data[:offset] + (new & mask).to_bytes(length, "big") + data[offset + length :]


def _change_value(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    """Replace one or two values of a message, without changing their number."""
    try:
        values = msgpack.unpackb(data)
        for _ in range(1 + chance.below(2)):
            values[chance.below(len(values))] = chance.choice(VALUES)
        packed: bytes = msgpack.packb(values, use_bin_type=chance.below(8) > 0)
    except Exception:  # an earlier mutation broke the message
        return data
    return packed


def _change_shape(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    """Insert, remove or swap values of a message."""
    try:
        values = msgpack.unpackb(data)
        index, other = chance.below(len(values)), chance.below(len(values))
        kind = chance.below(3)
        if kind == 0:
            values.insert(index, chance.choice(VALUES))
        elif kind == 1:
            values.pop(index)
        else:
            values[index], values[other] = values[other], values[index]
        packed: bytes = msgpack.packb(values)
    except Exception:  # an earlier mutation broke the message
        return data
    return packed


def _change_json(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    """Replace, remove or add a value of a JSON object; numbers that JSON does not have are written as Python does."""
    try:
        values = json.loads(data)
        name = chance.choice((*values, "x"))
        if chance.below(4):
            values[name] = chance.choice(VALUES)
        else:
            values.pop(name, None)
        return json.dumps(values, default=repr).encode(errors="surrogatepass")
    except Exception:  # an earlier mutation broke the message
        return data


def _prepend_json_bomb(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    return chance.choice(JSON_BOMBS) + data


def _prepend_bomb(data: bytes, _corpus: Corpus, chance: Chance) -> bytes:
    return chance.choice(BOMBS) + data


UNSTRUCTURED_MUTATIONS: Final[tuple[Mutation, ...]] = (_flip, _truncate, _lengthen, _splice, _overwrite, _remove)
BINARY_MUTATIONS: Final[tuple[Mutation, ...]] = (
    *UNSTRUCTURED_MUTATIONS,
    *(_change_field,) * len(UNSTRUCTURED_MUTATIONS),
)
JSON_MUTATIONS: Final[tuple[Mutation, ...]] = (
    *UNSTRUCTURED_MUTATIONS,
    *(_change_json,) * 2 * len(UNSTRUCTURED_MUTATIONS),
    _prepend_json_bomb,
)
PACKED_MUTATIONS: Final[tuple[Mutation, ...]] = (
    *UNSTRUCTURED_MUTATIONS,
    *(_change_value,) * len(UNSTRUCTURED_MUTATIONS),
    _change_shape,
    _prepend_bomb,
)
