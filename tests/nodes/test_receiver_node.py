from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from tests.nodes.stand_ins import at, give, of

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.node import WAKE, Send
from lavt.nodes.payloads import PathToken
from lavt.nodes.receiver import ReceiverNode
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.rtcp import parse_feedback, sender_report
from lavt.transport.rtp.rtcp_xr import ReferenceAnswer
from lavt.transport.rtp.rtp import Depacketizer, Packetizer
from lavt.transport.video.path_validation import HELLO_INTERVAL_NS, PathServer, is_path_datagram

TOKEN = bytes(range(16))
PORT = 5600
HOME = ("192.0.2.1", 5)
UNIT = b"\x00\x00\x00\x01\x67\x42\x00\x1e\x00\x00\x00\x01\x68\xce\x00\x00\x00\x01\x65" + bytes([9] * 5000)


def new_node(*, token: bool = True) -> ReceiverNode:
    node = ReceiverNode(JitterBuffer(), Depacketizer())
    if token:
        give(node, "path_token", PathToken(TOKEN, PORT), at(0))
    return node


def packets(number: int = 3) -> list[list[bytes]]:
    packetizer = Packetizer(77, 100)
    return [packetizer.packetize(UNIT, 3000 * each) for each in range(number)]


def test_it_is_silent_before_it_has_a_token() -> None:
    """Without a session there is nobody to say hello to, and no wake is asked for."""
    assert new_node(token=False).next_wake_ns() is None


def test_hello_challenge_answer() -> None:
    """It says hello at once and every 500 ms, answers the challenge, and so proves its path."""
    node = new_node()
    server = PathServer(lambda: bytes(32))
    server.set_token(TOKEN)
    (hello,) = give(node, WAKE, None, at(0))
    assert (hello.channel, hello.peer, is_path_datagram(hello.payload)) == ("feedback", PORT, True)
    assert node.next_wake_ns() == at(HELLO_INTERVAL_NS).mono_ns
    challenge = server.receive(hello.payload, HOME, at(0).mono_ns)
    (answer,) = give(node, "rtp", challenge, at(1))
    assert answer.channel == "feedback"
    server.receive(answer.payload, HOME, at(2).mono_ns)
    assert server.open_address(at(2).mono_ns) == HOME
    assert give(node, WAKE, None, at(HELLO_INTERVAL_NS))


def test_the_same_token_again_changes_nothing() -> None:
    """A session reply that repeats the token starts no new hello; a new token does."""
    node = new_node()
    give(node, WAKE, None, at(0))
    give(node, "path_token", PathToken(TOKEN, PORT), at(1))
    assert node.next_wake_ns() == at(HELLO_INTERVAL_NS).mono_ns
    give(node, "path_token", PathToken(bytes(16), PORT), at(1))
    assert node.next_wake_ns() == 0


def test_packets_become_access_units_with_their_arrival() -> None:
    """Packets in order become access units, each with the arrival of its last packet on the socket."""
    node = new_node()
    first, second, _ = packets()
    for packet in first:
        give(node, "rtp", packet, at(0))
    (unit,) = of(give(node, WAKE, None, at(10 * NS_PER_MS)), "access_unit")
    assert (unit.complete, unit.keyframe, unit.rtp_timestamp) == (True, True, 0)
    for packet in second:
        sends = give(node, "rtp", packet, at(12 * NS_PER_MS), arrived=at(11 * NS_PER_MS))
    (unit,) = of(sends, "access_unit")
    assert unit.packet_mono_ns == at(11 * NS_PER_MS).mono_ns


def test_reports_go_out_every_500_ms() -> None:
    """From the first packet on there is a receiver report every 500 ms, with the share that was lost."""
    node = new_node()
    first, second, third = packets()
    reports = []
    for at_ms in range(0, 2001, 5):
        if at_ms == 0:
            for packet in first:
                give(node, "rtp", packet, at(0))
        if at_ms == 600:
            for packet in [*second[:1], *second[2:], *third]:
                give(node, "rtp", packet, at(600 * NS_PER_MS))
        for send in give(node, WAKE, None, at(at_ms * NS_PER_MS)):
            if send.channel == "feedback" and not is_path_datagram(send.payload):
                reports += [(at_ms, report) for report in parse_feedback(send.payload).reports]
    assert [at_ms for at_ms, _ in reports] == [0, 500, 1000, 1500, 2000]
    assert [report.cumulative_lost for _, report in reports] == [0, 0, 1, 1, 1]
    lost_fraction = reports[2][1].lost_fraction
    assert abs(lost_fraction - 1 / (len(second) + len(third))) < 1 / 256
    assert reports[3][1].lost_fraction == 0


def asks(sends: list[Send]) -> bool:
    datagrams = [each for each in of(sends, "feedback") if not is_path_datagram(each)]
    return any(parse_feedback(each).picture_loss for each in datagrams)


def test_a_loss_asks_for_a_keyframe() -> None:
    """After a loss, and when the decoder has no picture, a keyframe is asked for, but once in 100 ms at most."""
    node = new_node()
    assert give(node, "picture_lost", None, at(0)) == []
    first, second, _ = packets()
    for packet in [*first, *second[1:]]:
        give(node, "rtp", packet, at(0))
    assert asks(give(node, WAKE, None, at(10 * NS_PER_MS)))
    times = [ms for ms in range(10, 400) if give(node, "picture_lost", None, at(ms * NS_PER_MS))]
    assert times == [110, 210, 310]
    assert node.counts["picture_loss_requests"] == 4


def answered(node: ReceiverNode, round_trip_ns: int, begin_ns: int = 0) -> None:
    """Let the node report, and the sender answer 30 ms after it heard."""
    (report,) = [each for each in of(give(node, WAKE, None, at(begin_ns)), "feedback") if not is_path_datagram(each)]
    (reference,) = parse_feedback(report).reference_times
    answer = ReferenceAnswer(reference.receiver_ssrc, reference.time, 30 * NS_PER_MS)
    datagram = sender_report(
        77, wall_ns=at(0).wall_ns, rtp_timestamp=0, packets=1, octets=1, cname="x", answered=[answer]
    )
    assert give(node, "rtp", datagram, at(begin_ns + round_trip_ns + 30 * NS_PER_MS)) == []


def test_it_asks_each_round_trip_until_the_keyframe_comes() -> None:
    """Once the round trip is known, a request that brought no keyframe is made again after it and an encoding."""
    node = new_node()
    first, second, third = packets()
    for packet in first:
        give(node, "rtp", packet, at(0))
    answered(node, 100 * NS_PER_MS)
    for packet in second[1:]:
        give(node, "rtp", packet, at(200 * NS_PER_MS))
    times = [ms for ms in range(200, 700) if asks(give(node, WAKE, None, at(ms * NS_PER_MS)))]
    assert times in ([210, 360, 510, 660], [210, 361, 512, 663]), "100 ms to 1/65536 s, and 50 ms"
    for packet in third:
        give(node, "rtp", packet, at(700 * NS_PER_MS))
    assert not any(asks(give(node, WAKE, None, at(ms * NS_PER_MS))) for ms in range(701, 1500))
    assert node.counts["picture_loss_requests"] == 4


def test_a_round_trip_that_was_long_once_does_not_hold_requests_back() -> None:
    """What counts is the round trip as it is known now, not as it was when the last keyframe was asked for."""
    node = new_node()
    first, second, _ = packets()
    for packet in first:
        give(node, "rtp", packet, at(0))
    answered(node, 3 * NS_PER_S)
    for packet in second[1:]:
        give(node, "rtp", packet, at(4 * NS_PER_S))
    assert asks(give(node, WAKE, None, at(4 * NS_PER_S + 10 * NS_PER_MS)))
    answered(node, 100 * NS_PER_MS, 4 * NS_PER_S + 600 * NS_PER_MS)
    assert asks(give(node, WAKE, None, at(4 * NS_PER_S + 740 * NS_PER_MS)))


def test_a_repaired_loss_costs_nothing() -> None:
    """A lost packet that a repair packet brings back leaves the access unit whole, and no keyframe is asked for."""
    node = new_node()
    first, second, _ = packets()
    repairs = RepairSender(78, 0).repair(second, 1)
    for packet in first:
        give(node, "rtp", packet, at(0))
    give(node, WAKE, None, at(10 * NS_PER_MS))
    for packet in [*second[:2], *second[3:]]:
        assert of(give(node, "rtp", packet, at(20 * NS_PER_MS)), "access_unit") == []
    sends = give(node, "rtp", repairs[0], at(25 * NS_PER_MS))
    assert [(unit.data, unit.complete) for unit in of(sends, "access_unit")] == [(UNIT, True)]
    assert not asks([*sends, *give(node, WAKE, None, at(50 * NS_PER_MS))])
    assert [node.counts[f"packets_{name}"] for name in ("recovered", "lost", "of_repair")] == [1, 0, 1]
    (report,) = [r for s in of(give(node, WAKE, None, at(NS_PER_S)), "feedback") if not is_path_datagram(s)
                 for r in parse_feedback(s).reports]  # fmt: skip
    assert report.cumulative_lost == 1, "as it is before repair"


def test_each_second_is_written_down() -> None:
    """The record has a line a second of how the stream arrived."""
    node = new_node()
    first, second, third = packets()
    samples = []
    for at_ms in range(0, 3001, 5):
        for number, frame in enumerate((first, second[1:], third)):
            if at_ms == 700 * number:
                for packet in frame:
                    give(node, "rtp", packet, at(at_ms * NS_PER_MS))
        samples += of(give(node, WAKE, None, at(at_ms * NS_PER_MS)), "reception")
    assert [sample.duration_ns for sample in samples] == [0, NS_PER_S, NS_PER_S, NS_PER_S]
    assert [sample.packets for sample in samples] == [len(first), len(second) - 1, len(third), 0]
    assert [sample.lost_after_repair for sample in samples] == [0, 1, 0, 0]


def test_a_bit_rate_is_requested_for_with_each_report() -> None:
    """The highest bit rate that is configured goes out with every report."""
    node = ReceiverNode(JitterBuffer(), Depacketizer(), 700_000)
    give(node, "path_token", PathToken(TOKEN, PORT), at(0))
    first, *_ = packets()
    for packet in first:
        give(node, "rtp", packet, at(0))
    for number in range(3):
        sends = of(give(node, WAKE, None, at(number * NS_PER_S // 2)), "feedback")
        limits = [limit for each in sends if not is_path_datagram(each) for limit in parse_feedback(each).limits]
        assert [(limit.media_ssrc, limit.overhead_bytes) for limit in limits] == [(77, 0)]
        assert 699_990 <= limits[0].bit_rate_bps <= 700_000


@given(st.one_of(st.binary(max_size=80), st.binary(max_size=80).map(lambda tail: b"LAVT" + tail)))
def test_any_datagram_is_survived_and_counted(datagram: bytes) -> None:
    """Whatever comes on the video's port is a packet, a challenge, or counted as unreadable."""
    node = new_node()
    give(node, "rtp", datagram, at(0))
    give(node, WAKE, None, at(NS_PER_S))
    packets, *unreadable = (
        node.counts.get(name, 0) for name in ("packets", "packets_unreadable", "challenges_unreadable")
    )
    assert packets + sum(unreadable) <= 1
    if len(datagram) < 12:
        assert (packets, sum(unreadable)) == (0, 1)


def test_a_challenge_without_a_session_is_counted() -> None:
    """A challenge that nobody asked for is not answered."""
    node = new_node(token=False)
    assert give(node, "rtp", b"LAVT" + bytes(26), at(0)) == []
    assert node.counts["challenges_unreadable"] == 1
