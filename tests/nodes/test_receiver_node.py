from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from tests.nodes.stand_ins import at, deliver, payloads

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
        deliver(node, "path_token", PathToken(TOKEN, PORT), at(0))
    return node


def packets_of_frames() -> list[list[bytes]]:
    """Return the packets of three frames, one list for each frame."""
    packetizer = Packetizer(77, 100)
    return [packetizer.packetize(UNIT, 3000 * number) for number in range(3)]


def test_without_a_token_nothing_is_sent() -> None:
    """Without a token the receiver sends nothing and requests no wake."""
    assert new_node(token=False).next_wake_ns() is None


def test_path_validation_by_hello_and_challenge() -> None:
    """The receiver sends a hello at once and every 500 ms, and answers the challenge."""
    node = new_node()
    server = PathServer(lambda: bytes(32))
    server.set_token(TOKEN)
    (hello,) = deliver(node, WAKE, None, at(0))
    assert (hello.channel, hello.peer, is_path_datagram(hello.payload)) == ("feedback", PORT, True)
    assert node.next_wake_ns() == at(HELLO_INTERVAL_NS).mono_ns
    challenge = server.receive(hello.payload, HOME, at(0).mono_ns)
    (answer,) = deliver(node, "rtp", challenge, at(1))
    assert answer.channel == "feedback"
    server.receive(answer.payload, HOME, at(2).mono_ns)
    assert server.open_address(at(2).mono_ns) == HOME
    assert deliver(node, WAKE, None, at(HELLO_INTERVAL_NS))


def test_the_same_token_again_changes_nothing() -> None:
    """A repeated token starts no new path validation; a new token does."""
    node = new_node()
    deliver(node, WAKE, None, at(0))
    deliver(node, "path_token", PathToken(TOKEN, PORT), at(1))
    assert node.next_wake_ns() == at(HELLO_INTERVAL_NS).mono_ns
    deliver(node, "path_token", PathToken(bytes(16), PORT), at(1))
    assert node.next_wake_ns() == 0


def test_packets_become_access_units() -> None:
    """Packets become access units with the arrival time of their last packet."""
    node = new_node()
    first, second, _ = packets_of_frames()
    for packet in first:
        deliver(node, "rtp", packet, at(0))
    (unit,) = payloads(deliver(node, WAKE, None, at(10 * NS_PER_MS)), "access_unit")
    assert (unit.complete, unit.keyframe, unit.rtp_timestamp) == (True, True, 0)
    for packet in second:
        sends = deliver(node, "rtp", packet, at(12 * NS_PER_MS), arrived=at(11 * NS_PER_MS))
    (unit,) = payloads(sends, "access_unit")
    assert unit.packet_mono_ns == at(11 * NS_PER_MS).mono_ns


def test_a_receiver_report_is_sent_every_500_ms() -> None:
    """A receiver report with the lost fraction is sent every 500 ms from the first packet on."""
    node = new_node()
    first, second, third = packets_of_frames()
    reports = []
    for at_ms in range(0, 2001, 5):
        if at_ms == 0:
            for packet in first:
                deliver(node, "rtp", packet, at(0))
        if at_ms == 600:
            for packet in [*second[:1], *second[2:], *third]:
                deliver(node, "rtp", packet, at(600 * NS_PER_MS))
        for send in deliver(node, WAKE, None, at(at_ms * NS_PER_MS)):
            if send.channel == "feedback" and not is_path_datagram(send.payload):
                reports += [(at_ms, report) for report in parse_feedback(send.payload).reports]
    assert [at_ms for at_ms, _ in reports] == [0, 500, 1000, 1500, 2000]
    assert [report.cumulative_lost for _, report in reports] == [0, 0, 1, 1, 1]
    lost_fraction = reports[2][1].lost_fraction
    assert abs(lost_fraction - 1 / (len(second) + len(third))) < 1 / 256
    assert reports[3][1].lost_fraction == 0


def rtcp_datagrams(sends: list[Send]) -> list[bytes]:
    return [datagram for datagram in payloads(sends, "feedback") if not is_path_datagram(datagram)]


def requests_keyframe(sends: list[Send]) -> bool:
    return any(parse_feedback(datagram).picture_loss for datagram in rtcp_datagrams(sends))


def test_a_loss_requests_a_keyframe() -> None:
    """A loss or a missing picture requests a keyframe, at most once in 100 ms."""
    node = new_node()
    assert deliver(node, "picture_lost", None, at(0)) == []
    first, second, _ = packets_of_frames()
    for packet in [*first, *second[1:]]:
        deliver(node, "rtp", packet, at(0))
    assert requests_keyframe(deliver(node, WAKE, None, at(10 * NS_PER_MS)))
    requested_at_ms = [ms for ms in range(10, 400) if deliver(node, "picture_lost", None, at(ms * NS_PER_MS))]
    assert requested_at_ms == [110, 210, 310]
    assert node.counts["picture_loss_requests"] == 4


def answer_report(node: ReceiverNode, round_trip_ns: int, begin_ns: int = 0) -> None:
    """Let the node send a report at `begin_ns`, and deliver the answer of a sender that waits 30 ms to answer."""
    (report,) = rtcp_datagrams(deliver(node, WAKE, None, at(begin_ns)))
    (reference,) = parse_feedback(report).reference_times
    answer = ReferenceAnswer(reference.receiver_ssrc, reference.time, 30 * NS_PER_MS)
    datagram = sender_report(
        77, wall_ns=at(0).wall_ns, rtp_timestamp=0, packets=1, octets=1, cname="x", answered=[answer]
    )
    assert deliver(node, "rtp", datagram, at(begin_ns + round_trip_ns + 30 * NS_PER_MS)) == []


def test_a_keyframe_request_is_repeated_each_round_trip() -> None:
    """With a known round trip, a keyframe request is repeated each round trip until the keyframe arrives."""
    node = new_node()
    first, second, third = packets_of_frames()
    for packet in first:
        deliver(node, "rtp", packet, at(0))
    answer_report(node, 100 * NS_PER_MS)
    for packet in second[1:]:
        deliver(node, "rtp", packet, at(200 * NS_PER_MS))
    requested_at_ms = [ms for ms in range(200, 700) if requests_keyframe(deliver(node, WAKE, None, at(ms * NS_PER_MS)))]
    assert requested_at_ms in ([210, 360, 510, 660], [210, 361, 512, 663]), (
        "the interval is the round trip of 100 ms (rounded to 1/65536 s) plus 50 ms for the keyframe"
    )
    for packet in third:
        deliver(node, "rtp", packet, at(700 * NS_PER_MS))
    assert not any(requests_keyframe(deliver(node, WAKE, None, at(ms * NS_PER_MS))) for ms in range(701, 1500))
    assert node.counts["picture_loss_requests"] == 4


def test_keyframe_requests_use_the_present_round_trip() -> None:
    """The interval of repeated requests follows the present round trip, not the one at the last request."""
    node = new_node()
    first, second, _ = packets_of_frames()
    for packet in first:
        deliver(node, "rtp", packet, at(0))
    answer_report(node, 3 * NS_PER_S)
    for packet in second[1:]:
        deliver(node, "rtp", packet, at(4 * NS_PER_S))
    assert requests_keyframe(deliver(node, WAKE, None, at(4 * NS_PER_S + 10 * NS_PER_MS)))
    answer_report(node, 100 * NS_PER_MS, 4 * NS_PER_S + 600 * NS_PER_MS)
    assert requests_keyframe(deliver(node, WAKE, None, at(4 * NS_PER_S + 740 * NS_PER_MS)))


def test_a_repaired_loss_requests_no_keyframe() -> None:
    """A packet recovered by a repair packet completes its access unit without a keyframe request."""
    node = new_node()
    first, second, _ = packets_of_frames()
    repairs = RepairSender(78, 0).make_repair_packets(second, 1)
    for packet in first:
        deliver(node, "rtp", packet, at(0))
    deliver(node, WAKE, None, at(10 * NS_PER_MS))
    for packet in [*second[:2], *second[3:]]:
        assert payloads(deliver(node, "rtp", packet, at(20 * NS_PER_MS)), "access_unit") == []
    sends = deliver(node, "rtp", repairs[0], at(25 * NS_PER_MS))
    assert [(unit.data, unit.complete) for unit in payloads(sends, "access_unit")] == [(UNIT, True)]
    assert not requests_keyframe([*sends, *deliver(node, WAKE, None, at(50 * NS_PER_MS))])
    assert [node.counts[f"packets_{name}"] for name in ("recovered", "lost", "of_repair")] == [1, 0, 1]
    datagrams = rtcp_datagrams(deliver(node, WAKE, None, at(NS_PER_S)))
    (report,) = [report for datagram in datagrams for report in parse_feedback(datagram).reports]
    assert report.cumulative_lost == 1, "losses are counted before repair"


def test_reception_is_recorded_every_second() -> None:
    """Reception statistics are recorded every second."""
    node = new_node()
    first, second, third = packets_of_frames()
    samples = []
    for at_ms in range(0, 3001, 5):
        for number, frame in enumerate((first, second[1:], third)):
            if at_ms == 700 * number:
                for packet in frame:
                    deliver(node, "rtp", packet, at(at_ms * NS_PER_MS))
        samples += payloads(deliver(node, WAKE, None, at(at_ms * NS_PER_MS)), "reception")
    assert [sample.duration_ns for sample in samples] == [0, NS_PER_S, NS_PER_S, NS_PER_S]
    assert [sample.packets for sample in samples] == [len(first), len(second) - 1, len(third), 0]
    assert [sample.lost_after_repair for sample in samples] == [0, 1, 0, 0]


def test_the_driver_gets_the_samples_if_a_person_drives() -> None:
    """With `informs_driver` the driver gets each sample that is recorded; without, it gets none."""
    for informs_driver in (True, False):
        node = ReceiverNode(JitterBuffer(), Depacketizer(), informs_driver=informs_driver)
        (packet, *_), *_ = packets_of_frames()
        deliver(node, "rtp", packet, at(0))
        sends = deliver(node, WAKE, None, at(NS_PER_S))
        assert len(payloads(sends, "reception")) == 1
        assert payloads(sends, "video_reception") == payloads(sends, "reception") * informs_driver


def test_the_bit_rate_is_requested_with_each_report() -> None:
    """The configured maximum bit rate is sent with every report."""
    node = ReceiverNode(JitterBuffer(), Depacketizer(), 700_000)
    deliver(node, "path_token", PathToken(TOKEN, PORT), at(0))
    first, *_ = packets_of_frames()
    for packet in first:
        deliver(node, "rtp", packet, at(0))
    for number in range(3):
        datagrams = rtcp_datagrams(deliver(node, WAKE, None, at(number * NS_PER_S // 2)))
        limits = [limit for datagram in datagrams for limit in parse_feedback(datagram).limits]
        assert [(limit.media_ssrc, limit.overhead_bytes) for limit in limits] == [(77, 0)]
        assert 699_990 <= limits[0].bit_rate_bps <= 700_000


@given(st.one_of(st.binary(max_size=80), st.binary(max_size=80).map(lambda tail: b"LAVT" + tail)))
def test_any_datagram_is_survived_and_counted(datagram: bytes) -> None:
    """Any datagram on the video port is a packet, a challenge, or counted as unreadable."""
    node = new_node()
    deliver(node, "rtp", datagram, at(0))
    deliver(node, WAKE, None, at(NS_PER_S))
    readable, *unreadable = (
        node.counts.get(name, 0) for name in ("packets", "packets_unreadable", "challenges_unreadable")
    )
    assert readable + sum(unreadable) <= 1
    if len(datagram) < 12:
        assert (readable, sum(unreadable)) == (0, 1)


def test_a_challenge_without_a_session_is_counted() -> None:
    """A challenge without a session is counted and not answered."""
    node = new_node(token=False)
    assert deliver(node, "rtp", b"LAVT" + bytes(26), at(0)) == []
    assert node.counts["challenges_unreadable"] == 1
