from __future__ import annotations

from tests.nodes.stand_ins import MONO_NS, at, deliver

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


def test_the_time_source_is_queried_once_a_second() -> None:
    """The host's time source is queried at the start and every second; missed queries are skipped."""
    node = ClockSyncNode(MONO_NS)
    assert node.next_wake_ns() == MONO_NS
    assert deliver(node, WAKE, None, at(0)) == [Send("clock_query", None)]
    assert node.next_wake_ns() == at(NS_PER_S).mono_ns
    deliver(node, WAKE, None, at(7 * NS_PER_S))
    assert node.next_wake_ns() == at(8 * NS_PER_S).mono_ns


def test_lateness_does_not_accumulate() -> None:
    """After late wakes, the next wake is at a full second again, and missed wakes are skipped."""
    node = ClockSyncNode(MONO_NS)
    for late_ms, next_s in ((400, 1), (1_400, 2), (4_900, 5), (5_000, 6)):
        deliver(node, WAKE, None, at(late_ms * NS_PER_MS))
        assert node.next_wake_ns() == at(next_s * NS_PER_S).mono_ns


def test_a_report_is_recorded_unchanged() -> None:
    """A clock report is recorded unchanged."""
    (send,) = deliver(ClockSyncNode(MONO_NS), "clock_report", REPORT, at(5, 99))
    assert send == Send("clock", REPORT)


def test_the_client_probes_twice_a_second() -> None:
    """The client sends a numbered probe every 500 ms and queries its time source every second."""
    node = ProbingClockSyncNode(MONO_NS)
    sent = []
    for number in range(10):
        assert node.next_wake_ns() == at(number * NS_PER_S // 2).mono_ns
        sent += deliver(node, WAKE, None, at(number * NS_PER_S // 2 + 3))
    assert [send.channel for send in sent].count("clock_query") == 5
    requests = [decode_request(send.payload) for send in sent if send.channel == "probe_request"]
    assert requests == [(number + 1, at(number * NS_PER_S // 2 + 3).wall_ns) for number in range(10)]


def test_missed_probes_are_skipped() -> None:
    """After a stall the client sends one probe and one query, and wakes again at the next multiple of 500 ms."""
    node = ProbingClockSyncNode(MONO_NS)
    deliver(node, WAKE, None, at(0))
    sent = deliver(node, WAKE, None, at(3_700 * NS_PER_MS))
    assert [send.channel for send in sent] == ["clock_query", "probe_request"]
    assert node.next_wake_ns() == at(4_000 * NS_PER_MS).mono_ns


def test_a_reply_has_times_correction_and_bound() -> None:
    """A reply has the times of arrival and answer, and the last correction and bound of the server."""
    node = ClockSyncNode(MONO_NS)
    message = Message("probe_request", encode_request(9, 1234), at(0), ("client", 1))
    ((_, answer),) = node.pipelines["probe_request"]
    (send,) = answer(message, at(400))
    assert (send.channel, send.peer) == ("probe_reply", ("client", 1))
    assert decode_reply(send.payload) == ProbeReply(9, 1234, at(0).wall_ns, at(400).wall_ns, None, None)
    deliver(node, "clock_report", REPORT, at(0))
    (send,) = answer(message, at(400))
    assert decode_reply(send.payload) == ProbeReply(9, 1234, at(0).wall_ns, at(400).wall_ns, 0.25, 0.001)


def test_a_clock_that_is_set_back_between_arrival_and_answer() -> None:
    """If the clock is set back before the reply, the answer time is the arrival time, never an earlier one."""
    message = Message("probe_request", encode_request(9, 1234), at(0), ("client", 1))
    ((_, answer),) = ClockSyncNode(MONO_NS).pipelines["probe_request"]
    (send,) = answer(message, at(400, -NS_PER_S))
    reply = decode_reply(send.payload)
    assert reply.answered_wall_ns == reply.received_wall_ns == at(0).wall_ns


def test_an_exchange_is_recorded_with_its_four_times() -> None:
    """An exchange is recorded with its four times, which give offset and round trip."""
    node = ProbingClockSyncNode(MONO_NS)
    deliver(node, WAKE, None, at(0))
    sent_ns = at(0).wall_ns
    reply = ProbeReply(1, sent_ns, sent_ns + 250_000_300, sent_ns + 250_000_350, None, None)
    (send,) = deliver(node, "probe_reply", encode_reply(reply), at(750))
    probe = ClockProbe(1, sent_ns, sent_ns + 250_000_300, sent_ns + 250_000_350, sent_ns + 750)
    assert send == Send("clock_probe", probe)
    assert probe.offset_ns == 250_000_000 - 50, "300 ns there and 400 ns back: half the difference is the error"
    assert probe.round_trip_ns == 700


def test_an_invalid_reply_is_counted() -> None:
    """Garbage, repeated replies, and replies with an unknown number or send time are counted and not recorded."""
    node = ProbingClockSyncNode(MONO_NS)
    deliver(node, WAKE, None, at(0))
    for data in (b"", bytes(48), encode_request(1, at(0).wall_ns)):
        assert not deliver(node, "probe_reply", data, at(1))
    for reply in (ProbeReply(2, at(0).wall_ns, 5, 6, None, None), ProbeReply(1, 77, 5, 6, None, None)):
        assert not deliver(node, "probe_reply", encode_reply(reply), at(1))
    assert node.counts["probes_rejected"] == 5
    good = ProbeReply(1, at(0).wall_ns, 5, 6, None, None)
    assert deliver(node, "probe_reply", encode_reply(good), at(1))
    assert not deliver(node, "probe_reply", encode_reply(good), at(1))
    assert node.counts["probes_rejected"] == 6


def test_the_server_counts_garbage() -> None:
    """Garbage and replies sent to the server are counted and not answered."""
    node = ClockSyncNode(MONO_NS)
    for data in (b"", b"LC", bytes(48), encode_reply(ProbeReply(1, 2, 3, 4, None, None)), encode_request(1, 2) + b"x"):
        assert not deliver(node, "probe_request", data, at(0))
    assert node.counts["probes_rejected"] == 5


def test_unanswered_probes_are_counted() -> None:
    """Probes older than two seconds without a reply are counted as unanswered."""
    node = ProbingClockSyncNode(MONO_NS)
    for number in range(50):
        deliver(node, WAKE, None, at(number * NS_PER_S // 2))
    assert node.counts["probes_unanswered"] == 46, "the last four are less than 2 s old"
