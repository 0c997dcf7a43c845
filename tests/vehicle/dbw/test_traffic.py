"""What is heard on a bus is told in words: each message, how often, what it says, what changed and what is wrong."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.assembly.dbw import load_profile
from lavt.assembly.dbw_bus import expected_traffic
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.can_frame import CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.traffic import MOST_UNKNOWN, OTHERS, BusTraffic, ExpectedMessages, MessageSummary, signal_words

GENERATION_1, GENERATION_2 = load_profile("dataspeed_gen1"), load_profile("dataspeed_gen2")
EXPECTED = expected_traffic(GENERATION_2)


def listening() -> BusTraffic:
    """Somebody who knows generation 2, since time 0."""
    return BusTraffic(GENERATION_2.codec, EXPECTED, start_ns=0)


def report(angle: int, count: int, *, damage: int = 0) -> CanFrame:
    """A SteerReport1 with its checksum."""
    data = bytes([angle, 0, 0, 0, 0, 0, count << 4])
    return CanFrame(0x100, data + bytes([frame_crc8(0x100, data) ^ damage]))


def told(traffic: BusTraffic, now_ns: int, name: str = "SteerReport1") -> MessageSummary:
    return next(each for each in traffic.tell(now_ns) if each.facts.name == name)


def test_rate_and_changes() -> None:
    """A message is told with how often it came since the last time, its newest values and those that changed."""
    traffic = listening()
    for number in range(100):
        traffic.hear(ReceivedCanFrame(report(7 if number < 50 else 9, number % 16), number * 10 * NS_PER_MS))
    first = told(traffic, NS_PER_S)
    assert (first.frames, first.rate_hz, first.changed, first.wrong) == (100, 100.0, ("ANGLE",), ())
    assert first.values["ANGLE"] == pytest.approx(0.9)
    traffic.hear(ReceivedCanFrame(report(9, 4), NS_PER_S))
    second = told(traffic, NS_PER_S + 50 * NS_PER_MS)
    assert (second.frames, second.rate_hz, second.changed, second.wrong) == (101, 20.0, (), ())


def test_in_all() -> None:
    """In the end the whole time is told, also what was told before."""
    traffic = listening()
    traffic.hear(ReceivedCanFrame(report(7, 1, damage=1), 0))
    traffic.tell(NS_PER_S)
    traffic.hear(ReceivedCanFrame(report(8, 2), NS_PER_S))
    (steering,) = (each for each in traffic.tell_all(2 * NS_PER_S) if each.facts.name == "SteerReport1")
    assert (steering.frames, steering.rate_hz, steering.changed) == (2, 1.0, ("ANGLE",))
    assert steering.wrong == ("its checksum is wrong", "silent for 1000 ms, longer than 100 ms")


def test_checksum_and_counter() -> None:
    """A wrong checksum and a counter that stands still are told, with how often."""
    traffic = listening()
    for count, damage in ((1, 0), (1, 0), (2, 4), (2, 0), (3, 0)):
        traffic.hear(ReceivedCanFrame(report(7, count, damage=damage), 0))
    assert told(traffic, 0).wrong == ("RC stands still (2 times)", "its checksum is wrong")
    traffic.hear(ReceivedCanFrame(report(7, 4), 0))
    assert told(traffic, 0).wrong == ()


@pytest.mark.parametrize(("gap_ms", "wrong"), [(100, ()), (101, ("silent for 101 ms, longer than 100 ms",))])
def test_late(gap_ms: int, wrong: tuple[str, ...]) -> None:
    """A report that pauses for longer than its time-out is told, while it pauses and when it is back."""
    traffic = listening()
    traffic.hear(ReceivedCanFrame(report(7, 1), 0))
    assert told(traffic, gap_ms * NS_PER_MS).wrong == wrong
    traffic.hear(ReceivedCanFrame(report(7, 2), gap_ms * NS_PER_MS))
    assert told(traffic, gap_ms * NS_PER_MS).wrong == wrong
    assert told(traffic, gap_ms * NS_PER_MS).wrong == ()


def test_never_came() -> None:
    """Reports that the profile needs are told though they never came, and in the order of their identifiers."""
    messages = listening().tell(0)
    assert [each.facts.identifier for each in messages] == [0x100, 0x101, 0x102, 0x103, 0x106, 0x107, 0x2D8]
    assert {each.wrong for each in messages} == {("never came",)}


def test_lengths() -> None:
    """A frame of another length is wrong, but for those that clear an override."""
    traffic = BusTraffic(GENERATION_1.codec, expected_traffic(GENERATION_1), start_ns=0)
    traffic.hear(ReceivedCanFrame(CanFrame(0x064, bytes([0, 0, 2, 0])), 0))
    assert told(traffic, 0, "SteeringCmd").values["CLEAR"] == 1
    assert told(traffic, 0, "SteeringCmd").wrong == ()
    traffic.hear(ReceivedCanFrame(CanFrame(0x064, bytes(5)), 0))
    traffic.hear(ReceivedCanFrame(CanFrame(0x067, bytes(3)), 0))
    assert told(traffic, 0, "SteeringCmd").wrong == ("has 5 bytes, not 8",)
    traffic.hear(ReceivedCanFrame(CanFrame(0x067, bytes(3)), 0))
    assert told(traffic, 0, "GearReport").wrong == ("has 3 bytes, not 2", "cannot be read")


def test_unknown() -> None:
    """Frames of no message are counted by identifier, and those of too many identifiers together."""
    traffic = listening()
    for identifier in range(0x10000, 0x10000 + MOST_UNKNOWN + 5):
        traffic.hear(ReceivedCanFrame(CanFrame(identifier, b"", is_extended=True), 0))
    traffic.hear(ReceivedCanFrame(CanFrame(0x100, bytes(8), is_extended=True), 0))
    traffic.hear(ReceivedCanFrame(CanFrame(0x10000, b"", is_extended=True), 0))
    assert traffic.unknown[0x10000, True] == 2
    assert traffic.unknown[OTHERS] == 6
    assert len(traffic.unknown) == MOST_UNKNOWN + 1


@given(st.lists(st.tuples(st.sampled_from([0x100, 0x106, 0x200, 0x201, 0x216, 0x333]), st.binary(max_size=8))))
def test_random_bus(frames: list[tuple[int, bytes]]) -> None:
    """Whatever a bus carries, each frame is told of once, and nothing raises."""
    traffic = listening()
    for identifier, data in frames:
        traffic.hear(ReceivedCanFrame(CanFrame(identifier, data), 0))
    assert sum(each.frames for each in traffic.tell(1)) + traffic.unknown.total() == len(frames)


def test_without_a_profile() -> None:
    """With a DBC alone nothing is expected, and messages are told as they come."""
    traffic = BusTraffic(GENERATION_2.codec, ExpectedMessages(), start_ns=0)
    assert traffic.tell(0) == []
    traffic.hear(ReceivedCanFrame(report(7, 1, damage=1), 0))
    assert told(traffic, NS_PER_S).wrong == ()


WORDS = [
    ("SteeringReport", "ANGLE", 12.3, "ANGLE 12.3 deg"),
    ("SteeringReport", "ANGLE", None, "ANGLE -"),
    ("SteeringReport", "ENABLED", 1, "ENABLED"),
    ("SteeringReport", "ENABLED", 0, ""),
    ("GearReport", "STATE", 4, "STATE DRIVE"),
    ("GearReport", "STATE", 6, "STATE 6"),
    ("MiscCmd", "PBRKCMD", 1, "PBRKCMD? 1"),
]


@pytest.mark.parametrize(("message", "signal", "value", "words"), WORDS)
def test_words(message: str, signal: str, value: float | None, words: str) -> None:
    """A value is said with its unit or its name, a flag by its name alone where set, an assumption with `?`."""
    assert signal_words(GENERATION_1.codec.messages[message].signals[signal], value) == words
