from __future__ import annotations

from dataclasses import replace

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_S, PATH_POINTS, Command
from lavt.streams import stream
from lavt.transport.messages import VERSION, encode
from lavt.transport.security.flood_filter import FloodFilter, RateLimiter, may_be_accepted

OTHERS_PER_S = 200
"""The limit that docs/wire.md states."""
EPOCH, SEQUENCE = 2**63 + 5, 1000
COMMAND = Command(EPOCH, SEQUENCE + 1, 1, 2, 3, 0.1, 0.2, 0.0, (0.0,) * PATH_POINTS, "drive", 0)
FLOOD_PER_S = 10_000


def new_screen() -> FloodFilter:
    """Make a screen to which everything that ends with a zero byte is the holder's."""
    return FloodFilter(lambda: (EPOCH, SEQUENCE), lambda data: data.endswith(b"\0"))


def passed(screen: FloodFilter, bodies: list[bytes], *, from_active_operator: bool = True) -> int:
    """Tell how many of `bodies`, which come within one second, go on."""
    end = b"\0" if from_active_operator else b"\1"
    return sum(screen.passes(body + end, body, number * NS_PER_S // len(bodies)) for number, body in enumerate(bodies))


def test_what_may_be_accepted_always_goes_on() -> None:
    """Commands of the epoch in force, newer than the last, go on however many they are."""
    commands = [encode(replace(COMMAND, sequence=SEQUENCE + 1 + number)) for number in range(FLOOD_PER_S)]
    screen = new_screen()
    assert passed(screen, commands) == FLOOD_PER_S
    assert not screen.counts


def test_of_a_flood_little_goes_on() -> None:
    """Of ten thousand a second that cannot be obeyed two hundred are looked at, and the others are counted."""
    chance = stream(1, "flood")
    floods = {
        "garbage": [chance.bytes(200) for _ in range(FLOOD_PER_S)],
        "another epoch": [encode(replace(COMMAND, epoch=number)) for number in range(FLOOD_PER_S)],
        "replayed": [encode(replace(COMMAND, sequence=SEQUENCE))] * FLOOD_PER_S,
        "too long": [bytes(5000)] * FLOOD_PER_S,
        "empty": [b""] * FLOOD_PER_S,
    }
    for name, flood in floods.items():
        screen = new_screen()
        assert (name, passed(screen, flood)) == (name, OTHERS_PER_S)
        assert screen.counts["commands_screened_out"] == FLOOD_PER_S - OTHERS_PER_S


def goes_on_always(screen: FloodFilter, command: Command) -> bool:
    """Tell whether a command goes on however often it comes, and not within what old commands may take."""
    body = encode(command)
    return passed(screen, [body] * (OTHERS_PER_S + 1)) == OTHERS_PER_S + 1


@pytest.mark.parametrize("noted", [[5], [3, 5], [5, 3]])
def test_commands_up_to_the_newest_one_noted_are_old(noted: list[int]) -> None:
    """Commands up to the newest authentic one go on within their limit only, in whatever order those came."""
    for after, always in ((4, False), (5, False), (6, True)):
        screen = new_screen()
        for number in noted:
            screen.note(encode(replace(COMMAND, sequence=SEQUENCE + number)))
        assert goes_on_always(screen, replace(COMMAND, sequence=SEQUENCE + after)) == always


@pytest.mark.parametrize("next_epoch", [EPOCH - 1, EPOCH + 1])
def test_a_new_epoch_begins_with_its_own_sequence(next_epoch: int) -> None:
    """The newest command of the epoch before makes none of the next epoch old; the newest of the next one does."""
    in_force = [(EPOCH, SEQUENCE)]
    screen = FloodFilter(lambda: in_force[0], lambda _data: True)
    screen.note(encode(replace(COMMAND, sequence=SEQUENCE + 5)))
    in_force[0] = next_epoch, 0
    first = replace(COMMAND, epoch=next_epoch, sequence=1)
    assert goes_on_always(screen, first)
    screen.note(encode(replace(COMMAND, sequence=SEQUENCE + 6)))
    assert goes_on_always(screen, first)
    screen.note(encode(first))
    assert not goes_on_always(screen, first)
    assert goes_on_always(screen, replace(first, sequence=2))


def test_what_is_not_the_holders_cannot_hide_what_is() -> None:
    """A flood of strangers, who copy epoch and sequence, leaves the holder's own commands alone, old ones too."""
    screen = new_screen()
    flood = [encode(replace(COMMAND, sequence=SEQUENCE + number)) for number in range(FLOOD_PER_S)]
    assert passed(screen, flood, from_active_operator=False) == OTHERS_PER_S
    assert passed(screen, [encode(replace(COMMAND, epoch=7))] * 50) == 50


def test_the_budget_is_for_each_second() -> None:
    """So many are taken in a second, none more, and as many again in the next."""
    budget = RateLimiter(3)
    assert [budget.take(at) for at in (5, 6, 7, 8, 9)] == [True, True, True, False, False]
    assert [budget.take(at) for at in (NS_PER_S - 1, NS_PER_S, NS_PER_S + 1)] == [False, True, True]
    assert [budget.take(2 * NS_PER_S - 1) for _ in range(2)] == [True, False]
    assert [budget.take(2 * NS_PER_S + at) for at in (0, 1, 2, 3)] == [True, True, True, False]


@given(st.binary(max_size=300))
def test_any_bytes_may_not_be_accepted(data: bytes) -> None:
    """What is not a command is not taken for one, and raises nothing."""
    assert not may_be_accepted(data, EPOCH, SEQUENCE)


@pytest.mark.parametrize(
    "head",
    [
        [VERSION + 1, EPOCH, SEQUENCE + 1],
        [float(VERSION), EPOCH, SEQUENCE + 1],
        [VERSION, float(EPOCH), SEQUENCE + 1],
        [VERSION, EPOCH, float(SEQUENCE + 1)],
        [VERSION, EPOCH],
        {VERSION: EPOCH, SEQUENCE + 1: 0},
    ],
)
def test_another_head_may_not_be_accepted(head: object) -> None:
    """A message of another version, or with other than whole numbers at its beginning, is not taken for a command."""
    assert may_be_accepted(msgpack.packb([VERSION, EPOCH, SEQUENCE + 1]), EPOCH, SEQUENCE)
    assert not may_be_accepted(msgpack.packb(head), EPOCH, SEQUENCE)


@pytest.mark.parametrize(("size", "may_be"), [(1024, True), (1025, False)])
def test_a_command_has_a_largest_size(size: int, *, may_be: bool) -> None:
    """A command of the largest size of a message is looked at, and one that is a byte longer is not."""
    assert may_be_accepted(encode(COMMAND).ljust(size, b"\0"), EPOCH, SEQUENCE) == may_be


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**63 - 1))
def test_the_head_of_any_command_is_read(epoch: int, sequence: int) -> None:
    """Epoch and sequence of any size are found at the beginning of a command."""
    body = encode(replace(COMMAND, epoch=epoch, sequence=sequence))
    assert may_be_accepted(body, epoch, sequence - 1)
    assert not may_be_accepted(body, epoch, sequence)
    assert not may_be_accepted(body, epoch ^ 1, sequence - 1)
