from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.errors import BadMessage
from lavt.transport.console.page_messages import (
    MAX_PAGE_MESSAGE_BYTES,
    PageAck,
    PageDelay,
    PageInput,
    PageStop,
    pack_unit,
    parse_hello,
    parse_page_message,
)

INPUT = {"type": "input", "seen_us": 5, "held": True, "live": True, "steering": -0.5, "throttle": 1, "brake": 0}


def test_messages_of_the_page() -> None:
    """Each kind of message is parsed."""
    assert parse_page_message(json.dumps(INPUT)) == PageInput(5, True, True, -0.5, 1.0, 0.0)
    assert parse_page_message('{"type": "ack", "unit": 4294967295}') == PageAck(2**32 - 1)
    assert parse_page_message('{"type": "stop"}') == PageStop()
    assert parse_page_message('{"type": "delay", "video_ms": 225, "control_ms": 0}') == PageDelay(225, 0)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[]",
        "{}",
        '{"type": "no"}',
        '{"type": "hello", "version": 1, "token": ""}',
        '{"type": "stop", "more": 1}',
        '{"type": "ack", "unit": 4294967296}',
        '{"type": "ack", "unit": -1}',
        '{"type": "ack", "unit": 1.5}',
        '{"type": "delay", "video_ms": 2001, "control_ms": 0}',
        '{"type": "delay", "video_ms": -1, "control_ms": 0}',
        "[" * 900,
        '{"type":' * 100,
        " " * (MAX_PAGE_MESSAGE_BYTES + 1),
        "\ud800",
        *(
            json.dumps({**INPUT, name: value}).replace('"=', "").replace('="', "")
            for name in ("steering", "throttle", "brake")
            for value in ("=NaN=", "=Infinity=", "=-Infinity=", "=1e999=", "=1e308=", 1.01, -1.01, "0", None, True)
        ),
        *(json.dumps({**INPUT, name: value}) for name in ("held", "live") for value in (1, "true", None)),
        *(json.dumps({**INPUT, "seen_us": value}) for value in (-1, 2**53, 1.5, "1", None)),
    ],
)
def test_bad_messages_are_rejected(text: str) -> None:
    """Anything that is not a message of the page, and any number that is not finite or out of range, is rejected."""
    with pytest.raises(BadMessage):
        parse_page_message(text)


@given(st.text() | st.binary() | st.recursive(st.none() | st.floats() | st.text(), st.lists).map(json.dumps))
def test_any_data_raises_only_bad_message(data: str | bytes) -> None:
    """Whatever the page sends, nothing but `BadMessage` is raised."""
    for parse in (parse_page_message, parse_hello):
        try:
            parse(data)
        except BadMessage:
            continue


@given(
    st.dictionaries(st.sampled_from(list(INPUT)), st.none() | st.booleans() | st.floats() | st.integers() | st.text())
)
def test_any_values_of_an_input(changes: dict[str, object]) -> None:
    """An input with any values is rejected, or its numbers are in range."""
    try:
        parsed = parse_page_message(json.dumps({**INPUT, **changes}))
    except BadMessage:
        return
    if isinstance(parsed, PageInput):
        assert -1 <= parsed.steering <= 1
        assert 0 <= parsed.throttle <= 1
        assert 0 <= parsed.brake <= 1


def test_the_head_of_an_access_unit() -> None:
    """The binary message has a head of 16 bytes, then the access unit."""
    packed = pack_unit(b"\x00\x00\x01", 2**32 - 1, is_keyframe=True, sent_us=2**40)
    assert packed == b"\x01\x01\x00\x00" + b"\xff" * 4 + (2**40).to_bytes(8, "big") + b"\x00\x00\x01"
