from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_S, PATH_POINTS, Command
from lavt.streams import stream
from lavt.transport.messages import encode
from lavt.transport.screen import Budget, CommandScreen, may_be_obeyed

OTHERS_PER_S = 200
"""The limit that docs/wire.md states."""
EPOCH, SEQUENCE = 2**63 + 5, 1000
COMMAND = Command(EPOCH, SEQUENCE + 1, 1, 2, 3, 0.1, 0.2, 0.0, (0.0,) * PATH_POINTS, "drive", 0)
FLOOD_PER_S = 10_000


def new_screen() -> CommandScreen:
    """Make a screen to which everything that ends with a zero byte is the holder's."""
    return CommandScreen(lambda: (EPOCH, SEQUENCE), lambda data: data.endswith(b"\0"))


def passed(screen: CommandScreen, bodies: list[bytes], *, from_holder: bool = True) -> int:
    """Tell how many of `bodies`, which come within one second, go on."""
    end = b"\0" if from_holder else b"\1"
    return sum(screen.passes(body + end, body, number * NS_PER_S // len(bodies)) for number, body in enumerate(bodies))


def test_what_may_be_obeyed_always_goes_on() -> None:
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


def test_what_is_not_the_holders_cannot_hide_what_is() -> None:
    """A flood of strangers, who copy epoch and sequence, leaves the holder's own commands alone, old ones too."""
    screen = new_screen()
    flood = [encode(replace(COMMAND, sequence=SEQUENCE + number)) for number in range(FLOOD_PER_S)]
    assert passed(screen, flood, from_holder=False) == OTHERS_PER_S
    assert passed(screen, [encode(replace(COMMAND, epoch=7))] * 50) == 50


def test_the_budget_is_for_each_second() -> None:
    """So many are taken in a second, none more, and as many again in the next."""
    budget = Budget(3)
    assert [budget.take(at) for at in (5, 6, 7, 8, 9)] == [True, True, True, False, False]
    assert [budget.take(NS_PER_S + at) for at in (5, 6, 7, 8)] == [True, True, True, False]


@given(st.binary(max_size=300))
def test_any_bytes_may_not_be_obeyed(data: bytes) -> None:
    """What is not a command is not taken for one, and raises nothing."""
    assert not may_be_obeyed(data, EPOCH, SEQUENCE)


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**63 - 1))
def test_the_head_of_any_command_is_read(epoch: int, sequence: int) -> None:
    """Epoch and sequence of any size are found at the beginning of a command."""
    body = encode(replace(COMMAND, epoch=epoch, sequence=sequence))
    assert may_be_obeyed(body, epoch, sequence - 1)
    assert not may_be_obeyed(body, epoch, sequence)
    assert not may_be_obeyed(body, epoch ^ 1, sequence - 1)
