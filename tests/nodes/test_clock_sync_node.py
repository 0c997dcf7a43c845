from __future__ import annotations

from tests.nodes.stand_ins import MONO_NS, at, give

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.node import WAKE, Message, Send
from lavt.nodes.clock_sync import ClockSyncNode, ProbingClockSyncNode
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.probe import (
    ClockProbe,
    ProbeReply,
    decode_reply,
    decode_request,
    encode_reply,
    encode_request,
)

REPORT = ClockReport(5, 7, "kernel", "chrony", 0.25, 0.001)


def test_it_asks_once_a_second() -> None:
    """The host's source of time is asked at the start and every second from then on, without catching up."""
    node = ClockSyncNode(MONO_NS)
    assert node.next_wake_ns() == MONO_NS
    assert give(node, WAKE, None, at(0)) == [Send("clock_query", None)]
    assert node.next_wake_ns() == at(NS_PER_S).mono_ns
    give(node, WAKE, None, at(7 * NS_PER_S))
    assert node.next_wake_ns() == at(8 * NS_PER_S).mono_ns


def test_being_late_does_not_add_up() -> None:
    """A node that is woken late asks by the same grid of seconds as ever, and leaves out the ticks that it missed."""
    node = ClockSyncNode(MONO_NS)
    for late_ms, next_s in ((400, 1), (1_400, 2), (4_900, 5), (5_000, 6)):
        give(node, WAKE, None, at(late_ms * NS_PER_MS))
        assert node.next_wake_ns() == at(next_s * NS_PER_S).mono_ns


def test_a_report_is_written_down_as_it_is() -> None:
    """What the source says is written down with the reading of the clocks that it belongs to."""
    (send,) = give(ClockSyncNode(MONO_NS), "clock_report", REPORT, at(5, 99))
    assert send == Send("clock", REPORT)


def test_the_client_probes_twice_a_second() -> None:
    """The client sends a probe every 500 ms, with a number and its time, and asks its source every second time."""
    node = ProbingClockSyncNode(MONO_NS)
    sent = []
    for tick in range(10):
        assert node.next_wake_ns() == at(tick * NS_PER_S // 2).mono_ns
        sent += give(node, WAKE, None, at(tick * NS_PER_S // 2 + 3))
    assert [send.channel for send in sent].count("clock_query") == 5
    requests = [decode_request(send.payload) for send in sent if send.channel == "probe_request"]
    assert requests == [(tick + 1, at(tick * NS_PER_S // 2 + 3).wall_ns) for tick in range(10)]


def test_late_probes_are_not_made_up_for() -> None:
    """A client that was held up sends one probe and asks its source once, and goes on by the same grid."""
    node = ProbingClockSyncNode(MONO_NS)
    give(node, WAKE, None, at(0))
    sent = give(node, WAKE, None, at(3_700 * NS_PER_MS))
    assert [send.channel for send in sent] == ["clock_query", "probe_request"]
    assert node.next_wake_ns() == at(4_000 * NS_PER_MS).mono_ns


def test_the_server_answers_with_its_times_and_what_its_source_said_last() -> None:
    """A reply goes to whoever asked, with the time of arrival, the time of the answer, correction and bound."""
    node = ClockSyncNode(MONO_NS)
    message = Message("probe_request", encode_request(9, 1234), at(0), ("client", 1))
    (stage,) = node.chains["probe_request"]
    (send,) = stage[1](message, at(400))
    assert (send.channel, send.peer) == ("probe_reply", ("client", 1))
    assert decode_reply(send.payload) == ProbeReply(9, 1234, at(0).wall_ns, at(400).wall_ns, None, None)
    give(node, "clock_report", REPORT, at(0))
    (send,) = stage[1](message, at(400))
    assert decode_reply(send.payload) == ProbeReply(9, 1234, at(0).wall_ns, at(400).wall_ns, 0.25, 0.001)


def test_a_clock_that_is_set_back_between_arrival_and_answer() -> None:
    """The server never says that it answered before it was asked: a client would take that for garbage."""
    message = Message("probe_request", encode_request(9, 1234), at(0), ("client", 1))
    (send,) = ClockSyncNode(MONO_NS).chains["probe_request"][0][1](message, at(400, -NS_PER_S))
    reply = decode_reply(send.payload)
    assert reply.answered_wall_ns == reply.received_wall_ns == at(0).wall_ns


def test_an_exchange_is_written_down_with_all_four_times() -> None:
    """The client writes down t1 to t4; the offset is half of both ways' difference, the round trip lacks t2 to t3."""
    node = ProbingClockSyncNode(MONO_NS)
    give(node, WAKE, None, at(0))
    sent_ns = at(0).wall_ns
    reply = ProbeReply(1, sent_ns, sent_ns + 250_000_300, sent_ns + 250_000_350, None, None)
    (send,) = give(node, "probe_reply", encode_reply(reply), at(750))
    probe = ClockProbe(1, sent_ns, sent_ns + 250_000_300, sent_ns + 250_000_350, sent_ns + 750)
    assert send == Send("clock_probe", probe)
    assert probe.offset_ns == 250_000_000 - 50
    assert probe.round_trip_ns == 700


def test_what_is_no_answer_is_counted() -> None:
    """Garbage, a reply to nothing, a second reply and one with another t1 are counted and not written down."""
    node = ProbingClockSyncNode(MONO_NS)
    give(node, WAKE, None, at(0))
    for data in (b"", bytes(48), encode_request(1, at(0).wall_ns)):
        assert not give(node, "probe_reply", data, at(1))
    for reply in (ProbeReply(2, at(0).wall_ns, 5, 6, None, None), ProbeReply(1, 77, 5, 6, None, None)):
        assert not give(node, "probe_reply", encode_reply(reply), at(1))
    assert node.counts["probes_rejected"] == 5
    good = ProbeReply(1, at(0).wall_ns, 5, 6, None, None)
    assert give(node, "probe_reply", encode_reply(good), at(1))
    assert not give(node, "probe_reply", encode_reply(good), at(1))
    assert node.counts["probes_rejected"] == 6


def test_the_server_counts_garbage() -> None:
    """What is no request is counted and not answered; nor is a reply, so that two servers keep still."""
    node = ClockSyncNode(MONO_NS)
    for data in (b"", b"LC", bytes(48), encode_reply(ProbeReply(1, 2, 3, 4, None, None)), encode_request(1, 2) + b"x"):
        assert not give(node, "probe_request", data, at(0))
    assert node.counts["probes_rejected"] == 5


def test_unanswered_probes_are_counted_and_forgotten() -> None:
    """Where no answer comes the client remembers the last two seconds, and counts the rest as unanswered."""
    node = ProbingClockSyncNode(MONO_NS)
    for tick in range(50):
        give(node, WAKE, None, at(tick * NS_PER_S // 2))
    assert node.counts["probes_unanswered"] == 46
