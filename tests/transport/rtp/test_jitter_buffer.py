from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.rtp.jitter_buffer import JitterBuffer, Ordered
from lavt.transport.rtp.rtp import RtpPacket

CAPACITY, MAX_JUMP = 1024, 3000
MIN_HOLD_NS, MAX_HOLD_NS, WINDOW_NS = 10 * NS_PER_MS, 300 * NS_PER_MS, 30 * NS_PER_S
"""The design's limits, repeated here: a change of the code's limits must change these, too."""
HOLD_NS = 10 * NS_PER_MS
STARTED_NS = HOLD_NS
"""When the first packet leaves `started_buffer`."""


def packet(sequence: int, ssrc: int = 7) -> RtpPacket:
    return RtpPacket(96, sequence % 2**16, 0, ssrc, False, b"")


def numbers(ordered: Ordered) -> list[int]:
    """Return the sequence numbers of all packets."""
    return [ordered_packet.sequence for ordered_packet, _ in ordered]


def numbers_after_gaps(ordered: Ordered) -> list[int]:
    """Return the sequence numbers of the packets that follow a gap."""
    return [ordered_packet.sequence for ordered_packet, lost_before in ordered if lost_before]


def started_buffer(first: int = 0, hold_ns: int | None = HOLD_NS) -> JitterBuffer:
    """Return a buffer that packet `first` has left at `STARTED_NS`."""
    buffer = JitterBuffer(hold_ns)
    buffer.push(packet(first), 0)
    assert numbers(buffer.expire(STARTED_NS)) == [first % 2**16]
    return buffer


def test_first_packets_wait_one_hold() -> None:
    """The first packets wait one hold, so that a stream begins with the packet sent first, even if it arrives later."""
    buffer = JitterBuffer(HOLD_NS)
    assert buffer.next_wake_ns() is None
    assert buffer.highest_sequence == 0
    assert buffer.push(packet(11), 100) == []
    assert buffer.push(packet(12), 100 + NS_PER_MS) == []
    assert buffer.push(packet(10), 100 + 2 * NS_PER_MS) == []
    assert buffer.next_wake_ns() == 100 + HOLD_NS
    assert buffer.expire(100 + HOLD_NS - 1) == []
    ordered = buffer.expire(100 + HOLD_NS)
    assert numbers(ordered) == [10, 11, 12]
    assert numbers_after_gaps(ordered) == []
    assert buffer.next_wake_ns() is None
    buffer.push(packet(10), 100 + HOLD_NS)
    buffer.push(packet(9), 100 + HOLD_NS)
    assert (buffer.duplicate, buffer.late) == (1, 1)


def test_packets_in_order_leave_immediately() -> None:
    """A packet in order leaves immediately, even if the sequence numbers wrap."""
    buffer = started_buffer(65_534)
    assert [numbers(buffer.push(packet(number), STARTED_NS)) for number in (65_535, 0, 1)] == [[65_535], [0], [1]]
    assert buffer.highest_sequence == 2**16 + 1


def test_gap_that_closes() -> None:
    """Packets after a gap leave with the packet that closes it, in order and without a loss."""
    buffer = started_buffer()
    assert buffer.push(packet(3), STARTED_NS) == []
    assert buffer.push(packet(2), STARTED_NS) == []
    ordered = buffer.push(packet(1), STARTED_NS + HOLD_NS - 1)
    assert numbers(ordered) == [1, 2, 3]
    assert numbers_after_gaps(ordered) == []
    assert (buffer.reordered, buffer.lost) == (2, 0)


def test_gap_that_stays() -> None:
    """After one hold a gap is given up, and the packet after it is marked."""
    buffer = started_buffer()
    assert buffer.push(packet(3), STARTED_NS) == []
    assert numbers(buffer.push(packet(4), STARTED_NS + 1)) == []
    assert buffer.next_wake_ns() == STARTED_NS + HOLD_NS
    ordered = buffer.expire(STARTED_NS + HOLD_NS)
    assert numbers(ordered) == [3, 4]
    assert numbers_after_gaps(ordered) == [3]
    assert buffer.lost == 2


def test_each_gap_has_its_own_hold() -> None:
    """The hold of a gap begins with the arrival of the first packet after that gap."""
    buffer = started_buffer()
    buffer.push(packet(2), STARTED_NS)
    buffer.push(packet(4), STARTED_NS + 3)
    assert numbers(buffer.expire(STARTED_NS + HOLD_NS)) == [2]
    assert buffer.next_wake_ns() == STARTED_NS + HOLD_NS + 3
    assert numbers_after_gaps(buffer.expire(STARTED_NS + HOLD_NS + 3)) == [4]


def test_packet_after_an_expired_hold_closes_its_gap() -> None:
    """A packet that closes a gap after the hold has expired is used if the gap has not been given up yet."""
    buffer = started_buffer()
    buffer.push(packet(2), STARTED_NS)
    assert numbers(buffer.push(packet(1), STARTED_NS + 2 * HOLD_NS)) == [1, 2]
    buffer.push(packet(4), STARTED_NS + 2 * HOLD_NS)
    assert numbers(buffer.push(packet(5), STARTED_NS + 4 * HOLD_NS)) == [4, 5]


def test_late_and_duplicate_packets_are_dropped() -> None:
    """A packet that arrives after its gap was given up, or twice, is dropped and counted as late or duplicate."""
    buffer = started_buffer(10)
    buffer.push(packet(12), STARTED_NS)
    assert buffer.push(packet(12), STARTED_NS) == []
    assert (buffer.late, buffer.duplicate) == (0, 1)
    buffer.expire(STARTED_NS + HOLD_NS)
    assert buffer.push(packet(11), STARTED_NS + HOLD_NS) == []
    assert (buffer.late, buffer.duplicate, buffer.lost) == (1, 1, 1)
    assert buffer.push(packet(11), STARTED_NS + HOLD_NS) == []
    assert buffer.push(packet(12), STARTED_NS + HOLD_NS) == []
    assert (buffer.late, buffer.duplicate) == (1, 3)
    assert buffer.push(packet(9), STARTED_NS + HOLD_NS) == []
    assert buffer.late == 2


def test_new_ssrc_begins_a_new_stream() -> None:
    """A new SSRC releases the buffered packets and begins a new stream, whose first packet is marked as after a gap."""
    buffer = started_buffer(50_000)
    buffer.push(packet(50_002), STARTED_NS)
    assert numbers(buffer.push(packet(40_000, ssrc=8), STARTED_NS)) == [50_002]
    ordered = buffer.expire(STARTED_NS + HOLD_NS)
    assert [(first.ssrc, first.sequence, lost_before) for first, lost_before in ordered] == [(8, 40_000, True)]
    assert buffer.highest_sequence == 40_000


def test_stray_packet_is_dropped() -> None:
    """A stray packet, which is alone and far from all others, is dropped and counted, and the stream continues."""
    buffer = started_buffer()
    assert buffer.push(packet(MAX_JUMP + 1), STARTED_NS) == []
    assert buffer.push(packet(-MAX_JUMP - 1), STARTED_NS) == []
    assert numbers(buffer.push(packet(1), STARTED_NS)) == [1]
    assert buffer.stray == 2
    assert buffer.next_wake_ns() is None


def test_the_farthest_packet_of_a_stream() -> None:
    """A packet at the greatest allowed distance from the newest one, on either side, belongs to the stream."""
    buffer = started_buffer(10_000)
    assert buffer.push(packet(10_000 + MAX_JUMP), STARTED_NS) == []
    assert numbers(buffer.expire(STARTED_NS + HOLD_NS)) == [10_000 + MAX_JUMP]
    assert buffer.push(packet(10_000), STARTED_NS + HOLD_NS) == []
    assert numbers(buffer.push_recovered(packet(10_000 + 2 * MAX_JUMP), STARTED_NS + HOLD_NS)) == []
    assert numbers(buffer.expire(STARTED_NS + 2 * HOLD_NS)) == [10_000 + 2 * MAX_JUMP]
    assert (buffer.stray, buffer.duplicate, buffer.recovered) == (0, 1, 1)


def test_stray_packets_that_are_not_consecutive() -> None:
    """Stray packets move the stream only if two arrive directly after each other with consecutive numbers."""
    buffer = started_buffer()
    for number, released in ((20_000, []), (20_002, []), (1, [1]), (20_003, []), (2, [2])):
        assert numbers(buffer.push(packet(number), STARTED_NS)) == released
    assert buffer.stray == 3


@pytest.mark.parametrize(("first", "second"), [(20_000, 20_001), (65_535, 0)])
def test_two_consecutive_packets_move_the_stream(first: int, second: int) -> None:
    """Two consecutive packets in another range move the stream there, and neither of them is dropped."""
    buffer = started_buffer(10_000)
    assert buffer.push(packet(first), STARTED_NS) == []
    assert buffer.push(packet(second), STARTED_NS) == []
    ordered = buffer.expire(STARTED_NS + HOLD_NS)
    assert numbers(ordered) == [first, second]
    assert numbers_after_gaps(ordered) == [first]
    assert (buffer.stray, buffer.lost) == (0, 0)


def test_the_extended_sequence_number_grows_at_a_jump() -> None:
    """When the stream jumps to another range, `highest_sequence` increases, by a wrap if necessary."""
    buffer = started_buffer(65_000)
    for number in (65_000 + MAX_JUMP + 1, 65_000 + MAX_JUMP + 2, 50_000, 50_001):
        buffer.push(packet(number), STARTED_NS)
        buffer.expire(STARTED_NS + HOLD_NS)
    assert buffer.highest_sequence == 2**16 + 50_001


def test_old_packets_after_a_delay_spike_are_late() -> None:
    """Many consecutive old packets are taken for late packets and not for a restart of the sender."""
    buffer = started_buffer()
    buffer.push(packet(1500), STARTED_NS)
    buffer.expire(STARTED_NS + HOLD_NS)
    for number in range(1, 1500):
        assert buffer.push(packet(number), STARTED_NS + HOLD_NS) == []
    assert (buffer.lost, buffer.late) == (1499, 1499)
    assert numbers(buffer.push(packet(1501), STARTED_NS + HOLD_NS)) == [1501]


def test_bounded_memory() -> None:
    """The number of buffered packets is limited for any hold."""
    buffer = JitterBuffer(hold_ns=10**15)
    released = [buffer.push(packet(2 * number), number) for number in range(CAPACITY + 50)]
    assert sum(len(ordered) for ordered in released) == 50


def test_bounded_memory_of_losses() -> None:
    """The number of remembered losses is limited, and lost packets that arrive are still counted as late."""
    buffer = started_buffer()
    for number in range(2, 5 * MAX_JUMP):
        buffer.push(packet(2 * number), STARTED_NS)
        buffer.expire(STARTED_NS + HOLD_NS)
        assert len(buffer._given_up) <= 2 * MAX_JUMP
    assert buffer.push(packet(2 * number - MAX_JUMP + 1), STARTED_NS) == []
    assert (buffer.late, buffer.duplicate) == (1, 0)


@given(st.integers(0, 2**16 - 1), st.permutations(range(30)), st.integers(0, 2**32))
def test_any_order_within_a_hold_is_restored(first: int, order: list[int], start_ns: int) -> None:
    """All packets that arrive within one hold, in any order, leave in the order in which they were sent."""
    buffer = JitterBuffer(HOLD_NS)
    ordered = [
        ordered_packet
        for position, number in enumerate(order)
        for ordered_packet in buffer.push(packet(first + number), start_ns + position * 1000)
    ]
    ordered += buffer.expire(start_ns + HOLD_NS)
    assert numbers(ordered) == [(first + number) % 2**16 for number in range(30)]
    assert numbers_after_gaps(ordered) == []
    assert (buffer.lost, buffer.late, buffer.duplicate) == (0, 0, 0)


ARRIVALS = st.lists(st.tuples(st.integers(0, 60), st.integers(0, 8 * NS_PER_MS)), min_size=1, max_size=80)


@given(st.integers(0, 2**16 - 1), ARRIVALS)
def test_any_arrivals(first: int, arrivals: list[tuple[int, int]]) -> None:
    """For any arrivals packets leave in order, gaps are marked, and each packet waits for one hold at most."""
    buffer = JitterBuffer(HOLD_NS)
    ordered: Ordered = []
    now_ns = 0
    for number, pause_ns in arrivals:
        now_ns += pause_ns
        ordered += buffer.push(packet(first + number), now_ns)
        wake_ns = buffer.next_wake_ns()
        assert wake_ns is None or now_ns < wake_ns <= now_ns + HOLD_NS
    ordered += buffer.expire(now_ns + HOLD_NS)
    assert buffer.next_wake_ns() is None
    sent = [(number - first) % 2**16 for number in numbers(ordered)]
    assert sent == sorted(set(sent))
    after_gaps = [after for before, after in pairwise(sent) if after != before + 1]
    assert numbers_after_gaps(ordered) == [(first + number) % 2**16 for number in after_gaps]
    assert buffer.lost == sent[-1] - sent[0] + 1 - len(sent)
    assert len(ordered) + buffer.late + buffer.duplicate == len(arrivals)


@given(st.lists(st.tuples(st.integers(0, 2**16 - 1), st.integers(0, 1), st.integers(0, HOLD_NS)), max_size=60))
def test_regular_stream_passes_after_any_packets(arrivals: list[tuple[int, int, int]]) -> None:
    """After any sequence numbers and SSRCs a regular stream passes the buffer."""
    buffer = JitterBuffer(HOLD_NS)
    now_ns = 0
    for sequence, ssrc, pause_ns in arrivals:
        now_ns += pause_ns
        buffer.push(packet(sequence, ssrc), now_ns)
    buffer.push(packet(0, ssrc=9), now_ns)
    buffer.expire(now_ns + HOLD_NS)
    assert numbers(buffer.push(packet(1, ssrc=9), now_ns + HOLD_NS)) == [1]


@pytest.mark.parametrize("first", [0, 40_000])
def test_recovered_packet_closes_its_gap(first: int) -> None:
    """A recovered packet closes its gap as a received packet does, and changes only the counter `recovered`."""
    buffer = started_buffer(first)
    assert buffer.push(packet(first + 2), STARTED_NS) == []
    ordered = buffer.push_recovered(packet(first + 1), STARTED_NS + 1)
    assert (numbers(ordered), numbers_after_gaps(ordered)) == ([first + 1, first + 2], [])
    assert numbers(buffer.push_recovered(packet(first + 3), STARTED_NS + 2)) == [first + 3]
    assert buffer.highest_sequence == first + 3
    assert (buffer.recovered, buffer.reordered, buffer.lost, buffer.late, buffer.duplicate) == (2, 0, 0, 0, 0)
    assert buffer.push(packet(first + 1), STARTED_NS + 3) == []
    assert buffer.duplicate == 1


def test_useless_recovered_packet_is_dropped() -> None:
    """A recovered packet is dropped if it is present, was given up, is far from the newest or is of another stream."""
    buffer = started_buffer()
    assert buffer.push(packet(2), STARTED_NS) == []
    assert buffer.push_recovered(packet(2), STARTED_NS) == []
    assert numbers(buffer.expire(STARTED_NS + HOLD_NS)) == [2]
    for recovered in (packet(1), packet(2), packet(3, ssrc=8), packet(2 + MAX_JUMP + 1)):
        assert buffer.push_recovered(recovered, STARTED_NS + HOLD_NS) == []
    counts = buffer.recovered, buffer.lost, buffer.late, buffer.duplicate, buffer.stray
    assert counts == (0, 1, 0, 0, 0)
    assert numbers(buffer.push(packet(3), STARTED_NS + HOLD_NS)) == [3]
    assert JitterBuffer(HOLD_NS).push_recovered(packet(0), 0) == []


def measure_hold(buffer: JitterBuffer, number: int, now_ns: int) -> int:
    """Lose packet `number` at `now_ns`; return how long the buffer waited for it."""
    assert buffer.push(packet(number + 1), now_ns) == []
    wake_ns = buffer.next_wake_ns()
    assert wake_ns is not None
    assert numbers(buffer.expire(wake_ns)) == [number + 1]
    return wake_ns - now_ns


def test_the_hold_follows_the_network() -> None:
    """After a reordering delay of 40 ms the hold is 50 ms, until the delay is forgotten."""
    buffer = started_buffer(hold_ns=None)
    assert measure_hold(buffer, 1, STARTED_NS) == MIN_HOLD_NS
    arrived_ns = STARTED_NS + 40 * NS_PER_MS
    assert buffer.push(packet(1), arrived_ns) == []
    assert (buffer.late, measure_hold(buffer, 3, arrived_ns)) == (1, 50 * NS_PER_MS)
    assert measure_hold(buffer, 5, arrived_ns + WINDOW_NS) == 50 * NS_PER_MS
    assert measure_hold(buffer, 7, arrived_ns + 3 * WINDOW_NS) == MIN_HOLD_NS


def test_the_hold_follows_packets_within_their_hold() -> None:
    """A reordering delay of 9 ms extends the hold, although the packet arrives within the hold of 10 ms."""
    buffer = started_buffer(hold_ns=None)
    buffer.push(packet(2), STARTED_NS)
    assert numbers(buffer.push(packet(1), STARTED_NS + 9 * NS_PER_MS)) == [1, 2]
    assert measure_hold(buffer, 3, STARTED_NS + 9 * NS_PER_MS) == 9 * NS_PER_MS * 5 // 4


def test_the_hold_follows_repairs() -> None:
    """A packet that is recovered after it was given up extends the hold."""
    buffer = started_buffer(hold_ns=None)
    measure_hold(buffer, 1, STARTED_NS)
    assert buffer.push_recovered(packet(1), STARTED_NS + 20 * NS_PER_MS) == []
    assert measure_hold(buffer, 3, STARTED_NS + 20 * NS_PER_MS) == 25 * NS_PER_MS


def test_the_hold_of_an_open_gap_grows() -> None:
    """A packet with a reordering delay of 9 ms also extends the hold of an earlier gap that is still open."""
    buffer = started_buffer(hold_ns=None)
    for number, after_ns in ((2, 0), (4, 0), (3, 9 * NS_PER_MS)):
        assert buffer.push(packet(number), STARTED_NS + after_ns) == []
    assert buffer.next_wake_ns() == STARTED_NS + 9 * NS_PER_MS * 5 // 4


def test_packets_of_no_gap_change_no_hold() -> None:
    """A packet from before the start does not change the hold, nor does a recovered packet that had already left."""
    buffer = started_buffer(10, hold_ns=None)
    assert buffer.push(packet(9), STARTED_NS + 50 * NS_PER_MS) == []
    assert buffer.push_recovered(packet(10), STARTED_NS + 50 * NS_PER_MS) == []
    assert (buffer.late, buffer.recovered) == (1, 0)
    assert measure_hold(buffer, 11, STARTED_NS + 50 * NS_PER_MS) == MIN_HOLD_NS


def test_too_long_delays_change_no_hold() -> None:
    """A reordering delay longer than the longest hold does not change the hold."""
    buffer = started_buffer(hold_ns=None)
    measure_hold(buffer, 1, STARTED_NS)
    buffer.push(packet(1), STARTED_NS + MAX_HOLD_NS + 1)
    assert measure_hold(buffer, 3, STARTED_NS + MAX_HOLD_NS + 1) == MIN_HOLD_NS


def test_swapped_packets_after_an_open_gap() -> None:
    """The reordering delay of swapped packets is measured from their own gap, not from an earlier gap that is open."""
    buffer = started_buffer(hold_ns=None)
    now_ns = STARTED_NS
    for number in range(2, 2000, 2):
        lost = number % 200 == 100
        for sequence in (number,) if lost else (number, number - 1):
            now_ns += NS_PER_MS // 5
            buffer.push(packet(sequence), now_ns)
    assert buffer.reordered > 900
    assert measure_hold(buffer, 2001, now_ns + NS_PER_S) == MIN_HOLD_NS


def test_the_hold_stays_long_enough_for_repairs() -> None:
    """While packets are recovered 20 ms after their gap, the hold stays longer than 20 ms."""
    buffer = started_buffer(hold_ns=None)
    measure_hold(buffer, 1, STARTED_NS)
    buffer.push_recovered(packet(1), STARTED_NS + 20 * NS_PER_MS)
    for second in range(1, 200):
        now_ns, number = STARTED_NS + second * NS_PER_S, 2 * second + 1
        assert buffer.push(packet(number + 1), now_ns) == []
        assert buffer.expire(now_ns + 20 * NS_PER_MS) == []
        assert numbers(buffer.push_recovered(packet(number), now_ns + 20 * NS_PER_MS)) == [number, number + 1]
    assert buffer.lost == 1


@given(ARRIVALS)
def test_any_arrivals_with_an_adaptive_hold(arrivals: list[tuple[int, int]]) -> None:
    """For any arrivals no packet waits longer than the longest hold, and each is counted."""
    buffer = JitterBuffer()
    left_count, now_ns = 0, 0
    for number, pause_ns in arrivals:
        now_ns += pause_ns
        left_count += len(buffer.push(packet(number), now_ns))
        wake_ns = buffer.next_wake_ns()
        assert wake_ns is None or now_ns < wake_ns <= now_ns + MAX_HOLD_NS
    left_count += len(buffer.expire(now_ns + MAX_HOLD_NS))
    assert buffer.next_wake_ns() is None
    assert left_count + buffer.late + buffer.duplicate == len(arrivals)
