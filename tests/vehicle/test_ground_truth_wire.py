"""Encoding of a software car's ground truth, and decoding of any datagrams."""

from __future__ import annotations

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import GroundTruth, VehicleEvent
from lavt.vehicle.ground_truth_wire import (
    MAX_BYTES,
    MAX_DETAIL,
    MAX_EVENTS,
    REPEATS,
    TruthReceiver,
    TruthSender,
    encode_truth,
)

START_NS = 5_000_000_000


def truth_at(mono_ns: int) -> GroundTruth:
    return GroundTruth(mono_ns, 1.5, -2.25, 0.5, 8.25, -0.01, 0.125, 0.0625, 321.5)


def event(detail: str, mono_ns: int = START_NS) -> VehicleEvent:
    return VehicleEvent(mono_ns, "lane_invasion", detail)


def test_a_datagram_is_decoded() -> None:
    """An encoded datagram is decoded to the same truth, and to events with time, kind and detail."""
    receiver = TruthReceiver()
    assert receiver.receive(encode_truth(truth_at(START_NS), [(7, event("left"))])) == [event("left")]
    assert receiver.newest == truth_at(START_NS)
    assert receiver.counts == {"truths": 1}


def test_an_event_is_repeated_and_returned_once() -> None:
    """An event is in 20 datagrams, each of which is sufficient, and is returned once."""
    sender = TruthSender(START_NS)
    datagrams = [sender.make_datagram(truth_at(START_NS), [event("left")])]
    datagrams += [sender.make_datagram(truth_at(START_NS + index), []) for index in range(30)]
    for first in range(30):
        receiver = TruthReceiver()
        received = [receiver.receive(datagram) for datagram in datagrams[first:]]
        assert received[0] == ([event("left")] if first < REPEATS else [])
        assert not any(received[1:])


def test_events_keep_their_order() -> None:
    """Events of lost datagrams are returned from the next datagram, in order and once."""
    sender, receiver = TruthSender(START_NS), TruthReceiver()
    sender.make_datagram(truth_at(1), [event("1")])
    sender.make_datagram(truth_at(2), [event("2"), event("3")])
    assert receiver.receive(sender.make_datagram(truth_at(3), [event("4")])) == [event(detail) for detail in "1234"]
    assert receiver.receive(sender.make_datagram(truth_at(4), [event("5")])) == [event("5")]


def test_many_events_wait_for_the_next_datagram() -> None:
    """A datagram has at most 16 events; further events are in the next datagrams, and no event is lost."""
    sender, receiver = TruthSender(START_NS), TruthReceiver()
    events = [event(str(index)) for index in range(3 * MAX_EVENTS)]
    received = receiver.receive(sender.make_datagram(truth_at(1), events))
    assert received == events[:MAX_EVENTS]
    for index in range(3 * REPEATS):
        received += receiver.receive(sender.make_datagram(truth_at(2 + index), []))
    assert received == events


def test_a_restarted_car() -> None:
    """Events of a restarted car are returned, although their numbering restarts."""
    receiver = TruthReceiver()
    first, second = TruthSender(START_NS), TruthSender(START_NS + 1_000_000)
    receiver.receive(first.make_datagram(truth_at(START_NS), [event("1"), event("2")]))
    assert receiver.receive(second.make_datagram(truth_at(START_NS + 1), [event("3")])) == [event("3")]


def test_an_old_truth_is_not_the_newest() -> None:
    """A truth older than the newest truth is counted and does not replace the newest; its events are returned."""
    receiver = TruthReceiver()
    receiver.receive(encode_truth(truth_at(START_NS), []))
    assert receiver.receive(encode_truth(truth_at(START_NS - 1), [(1, event("left"))])) == [event("left")]
    assert receiver.newest == truth_at(START_NS)
    assert receiver.counts == {"truths": 1, "old": 1}


def test_a_long_detail_is_cut() -> None:
    """An event's detail is cut to 200 characters and can be decoded."""
    (received,) = TruthReceiver().receive(encode_truth(truth_at(1), [(1, event("x" * 1000))]))
    assert received.detail == "x" * MAX_DETAIL


GOOD = (1, (1, *([0.5] * 8)), ((1, 1, "collision", "a rail"),))


def with_truth(*truth: object) -> tuple[object, ...]:
    return (1, truth, ())


def with_event(*fields: object) -> tuple[object, ...]:
    return (1, GOOD[1], (fields,))


@pytest.mark.parametrize(
    "wrong",
    [
        None,
        1,
        "truth",
        {},
        (),
        (1,),
        (2, *GOOD[1:]),
        (True, *GOOD[1:]),
        (1, (), ()),
        (1, GOOD[1], None),
        (1, GOOD[1], {}),
        (1, GOOD[1], (None,)),
        (1, GOOD[1], GOOD[2] * (MAX_EVENTS + 1)),
        with_truth(1, *([0.5] * 7)),
        with_truth(1, *([0.5] * 9)),
        with_truth(-1, *([0.5] * 8)),
        with_truth(2**63, *([0.5] * 8)),
        with_truth(0.5, *([0.5] * 8)),
        with_truth(1, *([0.5] * 7), True),
        with_truth(1, *([0.5] * 7), float("nan")),
        with_truth(1, float("inf"), *([0.5] * 7)),
        with_truth(1, *([0.5] * 7), "0.5"),
        with_event(1, 1, "collision"),
        with_event(-1, 1, "collision", ""),
        with_event(2**63, 1, "collision", ""),
        with_event(1, -1, "collision", ""),
        with_event(1, 1, "party", ""),
        with_event(1, 1, [], ""),
        with_event(1, 1, "collision", None),
        with_event(1, 1, "collision", "x" * 201),
    ],
)
def test_invalid_datagrams(wrong: object) -> None:
    """A datagram with any error is counted and dropped entirely, and the next valid datagram is received."""
    receiver = TruthReceiver()
    assert receiver.receive(bytes(msgpack.packb(wrong))) == []
    assert (receiver.newest, receiver.counts) == (None, {"garbage": 1})
    assert len(receiver.receive(bytes(msgpack.packb(GOOD)))) == 1


def test_a_datagram_that_is_too_long() -> None:
    """A datagram longer than any valid datagram is dropped without decoding."""
    receiver = TruthReceiver()
    receiver.receive(bytes(msgpack.packb(GOOD)).ljust(MAX_BYTES + 1, b"\0"))
    assert receiver.counts == {"garbage": 1}


junk = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=10) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
)


@given(st.binary(max_size=200) | junk.map(msgpack.packb))
def test_any_bytes(datagram: bytes) -> None:
    """Any bytes raise nothing and are counted once."""
    receiver = TruthReceiver()
    assert receiver.receive(datagram) == []
    assert sum(receiver.counts.values()) == 1


@given(st.integers(0, 300), st.integers(0, 255))
def test_a_datagram_with_a_wrong_byte(place: int, byte: int) -> None:
    """A valid datagram with one changed byte or cut at any place raises nothing."""
    datagram = bytearray(encode_truth(truth_at(START_NS), [(1, event("left"))]))
    receiver = TruthReceiver()
    receiver.receive(bytes(datagram[:place]))
    datagram[place % len(datagram)] = byte
    receiver.receive(bytes(datagram))
    assert sum(receiver.counts.values()) == 2
