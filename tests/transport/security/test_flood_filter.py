from __future__ import annotations

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from lavt.domain import NS_PER_S, PATH_POINTS, Command
from lavt.streams import stream
from lavt.transport.messages import VERSION, encode
from lavt.transport.security.flood_filter import FloodFilter, RateLimiter, may_be_accepted

UNACCEPTABLE_COMMANDS_PER_S = 200
"""The limit that docs/wire.md states."""
EPOCH, SEQUENCE = 2**63 + 5, 1000
COMMAND = Command(EPOCH, SEQUENCE + 1, 1, 2, 3, 0.1, 0.2, 0.0, (0.0,) * PATH_POINTS, "drive", 0)
FLOOD_PER_S = 10_000


def new_filter() -> FloodFilter:
    """Make a filter that takes an envelope for the active operator's if its last byte is zero."""
    return FloodFilter(lambda: (EPOCH, SEQUENCE), lambda data: data.endswith(b"\0"))


def count_passed(flood_filter: FloodFilter, bodies: list[bytes], *, from_active_operator: bool = True) -> int:
    """Send `bodies` within one second; return how many of them the filter passes."""
    end = b"\0" if from_active_operator else b"\1"
    return sum(
        flood_filter.passes(body + end, body, number * NS_PER_S // len(bodies)) for number, body in enumerate(bodies)
    )


def test_acceptable_commands_always_pass() -> None:
    """Commands of the epoch in force that are newer than the last one pass at any rate."""
    commands = [encode(replace(COMMAND, sequence=SEQUENCE + 1 + number)) for number in range(FLOOD_PER_S)]
    flood_filter = new_filter()
    assert count_passed(flood_filter, commands) == FLOOD_PER_S
    assert not flood_filter.counts


def test_unacceptable_commands_are_rate_limited() -> None:
    """Of 10000 unacceptable commands in a second, 200 pass, and the others are counted."""
    generator = stream(1, "flood")
    floods = {
        "garbage": [generator.bytes(200) for _ in range(FLOOD_PER_S)],
        "another epoch": [encode(replace(COMMAND, epoch=number)) for number in range(FLOOD_PER_S)],
        "replayed": [encode(replace(COMMAND, sequence=SEQUENCE))] * FLOOD_PER_S,
        "too long": [bytes(5000)] * FLOOD_PER_S,
        "empty": [b""] * FLOOD_PER_S,
    }
    for name, flood in floods.items():
        flood_filter = new_filter()
        assert (name, count_passed(flood_filter, flood)) == (name, UNACCEPTABLE_COMMANDS_PER_S)
        assert flood_filter.counts["commands_screened_out"] == FLOOD_PER_S - UNACCEPTABLE_COMMANDS_PER_S


def always_passes(flood_filter: FloodFilter, command: Command) -> bool:
    """Return whether a command passes more often than the rate limit for unacceptable commands permits."""
    body = encode(command)
    return count_passed(flood_filter, [body] * (UNACCEPTABLE_COMMANDS_PER_S + 1)) == UNACCEPTABLE_COMMANDS_PER_S + 1


@pytest.mark.parametrize("authentic", [[5], [3, 5], [5, 3]])
def test_commands_up_to_the_newest_authentic_one_are_replays(authentic: list[int]) -> None:
    """Commands up to the newest authentic one are rate-limited, in whatever order the authentic commands came."""
    for replayed, always in ((4, False), (5, False), (6, True)):
        flood_filter = new_filter()
        for number in authentic:
            flood_filter.note_authentic(encode(replace(COMMAND, sequence=SEQUENCE + number)))
        assert always_passes(flood_filter, replace(COMMAND, sequence=SEQUENCE + replayed)) == always


@pytest.mark.parametrize("next_epoch", [EPOCH - 1, EPOCH + 1])
def test_a_new_epoch_has_its_own_sequence(next_epoch: int) -> None:
    """An authentic command of the previous epoch does not make a command of the new epoch a replay."""
    in_force = [(EPOCH, SEQUENCE)]
    flood_filter = FloodFilter(lambda: in_force[0], lambda _data: True)
    flood_filter.note_authentic(encode(replace(COMMAND, sequence=SEQUENCE + 5)))
    in_force[0] = next_epoch, 0
    first = replace(COMMAND, epoch=next_epoch, sequence=1)
    assert always_passes(flood_filter, first)
    flood_filter.note_authentic(encode(replace(COMMAND, sequence=SEQUENCE + 6)))
    assert always_passes(flood_filter, first)
    flood_filter.note_authentic(encode(first))
    assert not always_passes(flood_filter, first)
    assert always_passes(flood_filter, replace(first, sequence=2))


def test_a_flood_by_others_does_not_displace_the_active_operator() -> None:
    """During a flood by others that copy epoch and sequence, the active operator's commands of an old epoch pass."""
    flood_filter = new_filter()
    flood = [encode(replace(COMMAND, sequence=SEQUENCE + number)) for number in range(FLOOD_PER_S)]
    assert count_passed(flood_filter, flood, from_active_operator=False) == UNACCEPTABLE_COMMANDS_PER_S
    assert count_passed(flood_filter, [encode(replace(COMMAND, epoch=7))] * 50) == 50


def test_a_rate_limit_counts_per_second() -> None:
    """A rate limiter permits its number of messages in a second, and as many again in the next."""
    limiter = RateLimiter(3)
    assert [limiter.take(now_ns) for now_ns in (5, 6, 7, 8, 9)] == [True, True, True, False, False]
    assert [limiter.take(now_ns) for now_ns in (NS_PER_S - 1, NS_PER_S, NS_PER_S + 1)] == [False, True, True]
    assert [limiter.take(2 * NS_PER_S - 1) for _ in range(2)] == [True, False]
    assert [limiter.take(2 * NS_PER_S + after_ns) for after_ns in (0, 1, 2, 3)] == [True, True, True, False]


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_no_command(data: bytes) -> None:
    """Arbitrary bytes are not mistaken for a command and raise nothing."""
    assert not may_be_accepted(data, EPOCH, SEQUENCE)


@pytest.mark.parametrize(
    "first_fields",
    [
        [VERSION + 1, EPOCH, SEQUENCE + 1],
        [float(VERSION), EPOCH, SEQUENCE + 1],
        [VERSION, float(EPOCH), SEQUENCE + 1],
        [VERSION, EPOCH, float(SEQUENCE + 1)],
        [VERSION, EPOCH],
    ],
)
def test_a_message_with_malformed_first_fields_is_no_command(first_fields: list[object]) -> None:
    """A message of another version, or without integers at its beginning, is not mistaken for a command."""
    _, _, _, *rest = msgpack.unpackb(encode(COMMAND))
    assert may_be_accepted(msgpack.packb([VERSION, EPOCH, SEQUENCE + 1, *rest]), EPOCH, SEQUENCE)
    assert not may_be_accepted(msgpack.packb([*first_fields, *rest]), EPOCH, SEQUENCE)


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**63 - 1))
def test_epoch_and_sequence_of_any_command_are_read(epoch: int, sequence: int) -> None:
    """Epoch and sequence of any size are read from the first fields of a command."""
    body = encode(replace(COMMAND, epoch=epoch, sequence=sequence))
    assert may_be_accepted(body, epoch, sequence - 1)
    assert not may_be_accepted(body, epoch, sequence)
    assert not may_be_accepted(body, epoch ^ 1, sequence - 1)
