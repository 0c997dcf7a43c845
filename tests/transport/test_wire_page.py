"""docs/wire.md has the fields, ranges and sizes of the code."""

from __future__ import annotations

import re
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import pytest
from msgspec import Meta

from lavt.domain import SessionRequest
from lavt.transport.messages import MAX_MESSAGE_BYTES, TYPES, VERSION, Name, NameOrEmpty, encode
from lavt.transport.rtp.srtp import WINDOW_PACKETS
from lavt.transport.security.envelope import MAX_AGREEMENTS, MAX_ENVELOPE_BYTES, MAX_PENDING_REQUESTS
from lavt.transport.security.gateway import STATES_PER_S
from lavt.transport.video.path_validation import TOKEN_BYTES

PAGE = (Path(__file__).parents[2] / "docs/wire.md").read_text()


def number_text(number: float) -> str:
    """Return a bound as the page writes it."""
    exponent = int(number).bit_length()
    if number >= 2**53:
        return f"2^{exponent} - 1" if number == 2**exponent - 1 else f"2^{exponent - 1}"
    return f"{number:_.0f}".replace("_", " ") if number == int(number) else str(number)


def type_text(annotation: Any) -> str:
    """Return the type and range of a field as the page writes it."""
    texts = {bool: "boolean", bytes: f"binary, 0 or {TOKEN_BYTES} bytes", Name: "name", NameOrEmpty: "name or empty"}
    if annotation in texts:
        return texts[annotation]
    if isinstance(annotation, UnionType) or get_origin(annotation) is Union:
        return ", or ".join("nil" if part is NoneType else type_text(part) for part in get_args(annotation))
    if get_origin(annotation) is Literal:
        return ", ".join(f"`{value}`" for value in get_args(annotation))
    assert get_origin(annotation) is Annotated
    kind, meta = get_args(annotation)
    assert isinstance(meta, Meta)
    if kind is bytes:
        return f"binary, at most {number_text(meta.max_length or 0)} bytes"
    if kind is str:
        return f"text, at most {meta.max_length} characters"
    if get_origin(kind) is tuple:
        assert meta.min_length == meta.max_length
        return f"array of {meta.max_length}: {type_text(get_args(kind)[0])}"
    low, high = meta.ge, 2**64 - 1 if meta.le is None else meta.le
    assert low is not None
    return f"{'integer' if kind is int else 'float'}, {number_text(low)} to {number_text(high)}"


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: str(kind.__name__))
def test_the_fields_of_each_message_are_documented(kind: type) -> None:
    """The page has each field of each message in its order, with type and range, and says what it means."""
    table = PAGE.partition(f"\n| {kind.__name__} |")[2].partition("\n\n")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("| ")]
    expected = [["0", "`version`", f"integer, {VERSION}"]]
    fields = TYPES[kind].items()
    expected += [[str(index), f"`{name}`", type_text(field)] for index, (name, field) in enumerate(fields, 1)]
    assert [row[:3] for row in rows] == expected, "\n".join(f"| {' | '.join(row)} | |" for row in expected)
    assert all(row[3] for row in rows[1:])


def test_the_example_of_a_message_is_what_is_sent() -> None:
    """The example of a message has the bytes that are sent."""
    data = encode(SessionRequest("acquire", "operator-1", 5, 0))
    assert f"`{data.hex(' ')}`" in PAGE


@pytest.mark.parametrize(
    ("pattern", "value"),
    [
        (r"at most (\d+) bytes: longer messages", MAX_MESSAGE_BYTES),
        (r"at most (\d+) bytes: longer envelopes", MAX_ENVELOPE_BYTES),
        (r"last (\d+) public keys", MAX_AGREEMENTS),
        (r"last (\d+) queries without a reply", MAX_PENDING_REQUESTS),
        (r"`token` has (\d+) random bytes", TOKEN_BYTES),
        (r"fewer than (\d+) packets behind", WINDOW_PACKETS),
        (r"verifies (\d+) other states a second", STATES_PER_S),
    ],
)
def test_a_documented_size_is_that_of_the_code(pattern: str, value: int) -> None:
    """Each size and limit that the page states is the constant of the code."""
    assert re.findall(pattern, PAGE) == [str(value)]
