"""Tests of the statistics of a bus: rate, values, changes and errors of each message."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.assembly.dbw import load_profile
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.can_frame import CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.traffic import (
    MAX_UNKNOWN,
    OTHER_IDENTIFIERS,
    BusTraffic,
    ExpectedMessages,
    MessageSummary,
    expected_traffic,
    signal_text,
)

GENERATION_1, GENERATION_2 = load_profile("dataspeed_gen1"), load_profile("dataspeed_gen2")
EXPECTED = expected_traffic(GENERATION_2)
STEERING_COMMAND_ID, GEAR_REPORT_ID = 0x064, 0x067
"""Identifiers of generation 1's messages SteeringCmd and GearReport."""


def new_traffic() -> BusTraffic:
    """Return the statistics of a bus with generation 2, started at time 0."""
    return BusTraffic(GENERATION_2.codec, EXPECTED, start_ns=0)


def report(tenths_deg: int, count: int, *, damage: int = 0) -> CanFrame:
    """Return a SteerReport1: ANGLE (0.1 deg), counter and checksum; `damage` inverts bits of the checksum."""
    data = bytes([tenths_deg, 0, 0, 0, 0, 0, count << 4])
    return CanFrame(0x100, data + bytes([frame_crc8(0x100, data) ^ damage]))


def summary_of(traffic: BusTraffic, now_ns: int, name: str = "SteerReport1") -> MessageSummary:
    return next(summary for summary in traffic.take_period(now_ns) if summary.facts.name == name)


def test_rate_and_changes() -> None:
    """A summary has the count of all frames so far, the newest values, and the period's rate and changed signals."""
    traffic = new_traffic()
    for number in range(100):
        tenths_deg = 7 if number < 50 else 9
        traffic.receive(ReceivedCanFrame(report(tenths_deg, number % 16), number * 10 * NS_PER_MS))
    full_second = summary_of(traffic, NS_PER_S)
    assert (full_second.frames, full_second.rate_hz) == (100, 100.0)
    assert (full_second.changed, full_second.wrong) == (("ANGLE",), ())
    assert full_second.values["ANGLE"] == pytest.approx(0.9)
    traffic.receive(ReceivedCanFrame(report(9, 4), NS_PER_S))
    next_50_ms = summary_of(traffic, NS_PER_S + 50 * NS_PER_MS)
    assert (next_50_ms.frames, next_50_ms.rate_hz) == (101, 1 / 0.05)
    assert (next_50_ms.changed, next_50_ms.wrong) == ((), ())


def test_total() -> None:
    """The total covers the whole time, including earlier periods."""
    traffic = new_traffic()
    traffic.receive(ReceivedCanFrame(report(7, 1, damage=1), 0))
    traffic.take_period(NS_PER_S)
    traffic.receive(ReceivedCanFrame(report(8, 2), NS_PER_S))
    (steering,) = (summary for summary in traffic.total(2 * NS_PER_S) if summary.facts.name == "SteerReport1")
    assert (steering.frames, steering.rate_hz, steering.changed) == (2, 1.0, ("ANGLE",))
    assert len(steering.wrong) == 2
    assert "checksum" in steering.wrong[0]
    assert "1000 ms" in steering.wrong[1]


def test_checksum_and_counter() -> None:
    """Wrong checksums and repeated counters are errors, each with the number of times."""
    traffic = new_traffic()
    for count, damage in ((1, 0), (1, 0), (2, 4), (2, 0), (3, 0)):
        traffic.receive(ReceivedCanFrame(report(7, count, damage=damage), 0))
    counter, checksum = summary_of(traffic, 0).wrong
    assert counter.startswith("RC ")
    assert "2 times" in counter
    assert "checksum" in checksum
    traffic.receive(ReceivedCanFrame(report(7, 4), 0))
    assert summary_of(traffic, 0).wrong == ()


@pytest.mark.parametrize(("gap_ms", "is_wrong"), [(100, False), (101, True)])
def test_a_gap_longer_than_the_timeout_is_an_error(gap_ms: int, is_wrong: bool) -> None:
    """A gap between reports that exceeds the timeout is an error, during the gap and in the period in which it ends."""
    traffic = new_traffic()
    traffic.receive(ReceivedCanFrame(report(7, 1), 0))
    errors = summary_of(traffic, gap_ms * NS_PER_MS).wrong
    assert len(errors) == is_wrong
    assert all(f"{gap_ms} ms" in error for error in errors)
    traffic.receive(ReceivedCanFrame(report(7, 2), gap_ms * NS_PER_MS))
    assert len(summary_of(traffic, gap_ms * NS_PER_MS).wrong) == is_wrong
    assert summary_of(traffic, gap_ms * NS_PER_MS).wrong == ()


def test_a_missing_report_is_an_error() -> None:
    """Expected reports are listed in the order of their identifiers, with an error if they were never received."""
    messages = new_traffic().take_period(0)
    identifiers = [summary.facts.identifier for summary in messages]
    assert identifiers == [0x100, 0x101, 0x102, 0x103, 0x106, 0x107, 0x2A4, 0x2D8]
    assert {len(summary.wrong) for summary in messages} == {1}
    assert all("never" in summary.wrong[0] for summary in messages)


def test_lengths() -> None:
    """A frame of a wrong length is an error, unless the frame clears an override."""
    traffic = BusTraffic(GENERATION_1.codec, expected_traffic(GENERATION_1), start_ns=0)
    traffic.receive(ReceivedCanFrame(CanFrame(STEERING_COMMAND_ID, bytes([0, 0, 2, 0])), 0))
    assert summary_of(traffic, 0, "SteeringCmd").values["CLEAR"] == 1
    assert summary_of(traffic, 0, "SteeringCmd").wrong == ()
    traffic.receive(ReceivedCanFrame(CanFrame(STEERING_COMMAND_ID, bytes(5)), 0))
    traffic.receive(ReceivedCanFrame(CanFrame(GEAR_REPORT_ID, bytes(3)), 0))
    assert summary_of(traffic, 0, "SteeringCmd").wrong == ("has 5 bytes, not 8",)
    traffic.receive(ReceivedCanFrame(CanFrame(GEAR_REPORT_ID, bytes(3)), 0))
    assert summary_of(traffic, 0, "GearReport").wrong == ("has 3 bytes, not 2", "cannot be decoded")


def test_unknown() -> None:
    """Unknown frames are counted by identifier; beyond a number of identifiers, all others are counted together."""
    traffic = new_traffic()
    for identifier in range(0x10000, 0x10000 + MAX_UNKNOWN + 5):
        traffic.receive(ReceivedCanFrame(CanFrame(identifier, b"", is_extended=True), 0))
    traffic.receive(ReceivedCanFrame(CanFrame(0x100, bytes(8), is_extended=True), 0))
    traffic.receive(ReceivedCanFrame(CanFrame(0x10000, b"", is_extended=True), 0))
    assert traffic.unknown[0x10000, True] == 2
    assert traffic.unknown[OTHER_IDENTIFIERS] == 6
    assert len(traffic.unknown) == MAX_UNKNOWN + 1


@given(st.lists(st.tuples(st.sampled_from([0x100, 0x106, 0x200, 0x201, 0x216, 0x333]), st.binary(max_size=8))))
def test_random_bus(frames: list[tuple[int, bytes]]) -> None:
    """Whatever frames are received, each is counted exactly once, and no error is raised."""
    traffic = new_traffic()
    for identifier, data in frames:
        traffic.receive(ReceivedCanFrame(CanFrame(identifier, data), 0))
    assert sum(summary.frames for summary in traffic.take_period(1)) + traffic.unknown.total() == len(frames)


def test_without_a_profile() -> None:
    """Without a profile no message is expected, and received messages are summarized."""
    traffic = BusTraffic(GENERATION_2.codec, ExpectedMessages(), start_ns=0)
    assert traffic.take_period(0) == []
    traffic.receive(ReceivedCanFrame(report(7, 1, damage=1), 0))
    assert summary_of(traffic, NS_PER_S).wrong == ()


TEXTS = [
    ("SteeringReport", "ANGLE", 12.3, "ANGLE 12.3 deg"),
    ("SteeringReport", "ANGLE", None, "ANGLE -"),
    ("SteeringReport", "ENABLED", 1, "ENABLED"),
    ("SteeringReport", "ENABLED", 0, ""),
    ("GearReport", "STATE", 4, "STATE DRIVE"),
    ("GearReport", "STATE", 6, "STATE 6"),
    ("MiscCmd", "PBRKCMD", 1, "PBRKCMD? 1"),
]


@pytest.mark.parametrize(("message", "signal", "value", "text"), TEXTS)
def test_signal_text(message: str, signal: str, value: float | None, text: str) -> None:
    """A value is shown with its unit or name, a set flag by its name alone, and an unverified signal with `?`."""
    assert signal_text(GENERATION_1.codec.messages[message].signals[signal], value) == text
