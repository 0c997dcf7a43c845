from __future__ import annotations

import struct
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.errors import UserError, WorkError
from lavt.transport.rtp.rtp import RtpPacket
from lavt.transport.rtp.srtp import KEY_BYTES, MAX_PACKET_BYTES, WINDOW_PACKETS, Protector, Unprotector

pytest.importorskip("pylibsrtp")

KEY, OTHER_KEY = bytes(range(KEY_BYTES)), bytes(range(1, KEY_BYTES + 1))
MEDIA_SSRC, REPAIR_SSRC = 0x01020304, 0x0A0B0C0D
RTCP_REPORT = struct.pack("!BBHIIIIII", 0x80, 200, 6, MEDIA_SSRC, 1, 2, 3, 4, 5)
"""A sender report without report blocks."""


def packet(sequence: int, payload: bytes = b"picture", ssrc: int = MEDIA_SSRC) -> bytes:
    return RtpPacket(96, sequence % 2**16, 9000, ssrc, False, payload).to_bytes()


def counters(unprotector: Unprotector) -> tuple[int, int]:
    """Return the numbers of rejected and of replayed packets."""
    return unprotector.rejected, unprotector.replayed


@given(
    payload=st.binary(max_size=MAX_PACKET_BYTES - 12),
    first=st.integers(0, 2**15 - 1),
    key=st.binary(min_size=28, max_size=28),
)
def test_round_trip(payload: bytes, first: int, key: bytes) -> None:
    """A packet is the same after it was protected and unprotected, for any payload, key and first number."""
    plain = packet(first, payload)
    protected = Protector(key).protect(plain)
    assert len(protected) == len(plain) + 16
    assert protected[:12] == plain[:12]
    assert Unprotector(key).unprotect(protected) == plain


def test_payload_is_not_readable() -> None:
    """A protected packet does not contain its payload in plain text."""
    assert b"picture" not in Protector(KEY).protect(packet(1, b"picture" * 100))


def test_sequence_numbers_wrap() -> None:
    """Every packet is accepted while the sequence numbers wrap twice."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    packets = [packet(sequence) for sequence in range(32000, 2 * 65536 + 100, 3)]
    assert [unprotector.unprotect(protector.protect(plain)) for plain in packets] == packets
    assert counters(unprotector) == (0, 0)


@given(st.permutations(range(65500, 65572)))
def test_reordered_at_the_wrap(order: list[int]) -> None:
    """Packets around the wrap are accepted in any order of arrival, once the stream is known."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    for sequence in (32000, 64000):
        assert unprotector.unprotect(protector.protect(packet(sequence)))
    protected = {sequence: protector.protect(packet(sequence)) for sequence in range(65500, 65572)}
    assert [unprotector.unprotect(protected[sequence]) for sequence in order] == [packet(number) for number in order]


def test_next_packet_after_many_missed_ones_is_accepted() -> None:
    """A receiver that missed 2^15 - 2 consecutive packets accepts the next one."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    protected = [protector.protect(packet(sequence)) for sequence in range(65000, 65000 + 2**15)]
    assert unprotector.unprotect(protected[0]) is not None
    assert unprotector.unprotect(protected[-1]) == packet(65000 + 2**15 - 1)


def test_first_packet_of_65535_missed() -> None:
    """If a stream begins at 65535 and that packet is lost, no later one is accepted: streams must begin below 2^15."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    protected = [protector.protect(packet(sequence)) for sequence in range(65535, 65535 + 100)]
    assert [unprotector.unprotect(datagram) for datagram in protected[1:]] == [None] * 99


def test_replay_window() -> None:
    """A packet 4095 numbers behind the newest is accepted, one 4096 behind is rejected."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    protected = [protector.protect(packet(sequence)) for sequence in range(WINDOW_PACKETS + 1)]
    assert unprotector.unprotect(protected[WINDOW_PACKETS]) is not None
    assert unprotector.unprotect(protected[1]) == packet(1)
    assert unprotector.unprotect(protected[0]) is None
    assert counters(unprotector) == (0, 1)


def test_packet_with_any_changed_bit_is_rejected() -> None:
    """A packet with any bit changed, in header, payload or tag, is rejected; the original is accepted afterwards."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    protected = protector.protect(packet(1))
    for bit in range(8 * len(protected)):
        changed = bytearray(protected)
        changed[bit // 8] ^= 1 << bit % 8
        assert unprotector.unprotect(bytes(changed)) is None
    assert counters(unprotector) == (8 * len(protected), 0)
    assert unprotector.unprotect(protected) == packet(1)


def test_truncated_packet_is_rejected() -> None:
    """A truncated packet is rejected."""
    unprotector = Unprotector(KEY)
    protected = Protector(KEY).protect(packet(1))
    assert [unprotector.unprotect(protected[:length]) for length in range(len(protected))] == [None] * len(protected)
    assert counters(unprotector) == (len(protected), 0)


def test_replayed_packets_are_rejected() -> None:
    """A packet that is received again after others is rejected and counted as a replay."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    protected = [protector.protect(packet(sequence)) for sequence in range(10)]
    assert all(unprotector.unprotect(datagram) for datagram in protected)
    assert [unprotector.unprotect(datagram) for datagram in protected] == [None] * 10
    assert counters(unprotector) == (0, 10)


def test_packet_under_another_key_is_rejected() -> None:
    """A packet protected under another key is rejected."""
    unprotector = Unprotector(OTHER_KEY)
    assert unprotector.unprotect(Protector(KEY).protect(packet(1))) is None
    assert unprotector.unprotect_rtcp(Protector(KEY).protect_rtcp(RTCP_REPORT)) is None
    assert counters(unprotector) == (2, 0)


def test_plain_packets_are_rejected() -> None:
    """Packets that were not protected are rejected."""
    unprotector = Unprotector(KEY)
    assert unprotector.unprotect(packet(1, bytes(100))) is None
    assert unprotector.unprotect_rtcp(RTCP_REPORT) is None
    assert counters(unprotector) == (2, 0)


@settings(max_examples=1000)
@given(st.binary(max_size=2000) | st.binary(max_size=100).map(lambda tail: packet(1) + tail))
def test_any_bytes(garbage: bytes) -> None:
    """Arbitrary bytes are rejected without an error, and each datagram is counted."""
    unprotector = Unprotector(KEY)
    assert unprotector.unprotect(garbage) is None
    assert unprotector.unprotect_rtcp(garbage) is None
    assert sum(counters(unprotector)) == 2


def test_forged_packets_do_not_block_authentic_ones() -> None:
    """Forged packets of the same stream with distant numbers do not cause a later authentic packet to be rejected."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    assert unprotector.unprotect(protector.protect(packet(1))) is not None
    for sequence in range(0, 2**16, 97):
        assert unprotector.unprotect(packet(sequence, bytes(50))) is None
    assert unprotector.unprotect(protector.protect(packet(2))) == packet(2)


def test_rtcp_is_encrypted_and_accepted_once() -> None:
    """RTCP packets are encrypted, accepted once each, and rejected if any bit is changed."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    first, second = protector.protect_rtcp(RTCP_REPORT), protector.protect_rtcp(RTCP_REPORT)
    assert len(first) == len(RTCP_REPORT) + 20
    assert first != second  # each packet has its own index
    assert RTCP_REPORT[8:] not in first
    for bit in range(8 * len(first)):
        changed = bytearray(first)
        changed[bit // 8] ^= 1 << bit % 8
        assert unprotector.unprotect_rtcp(bytes(changed)) is None
    assert [unprotector.unprotect_rtcp(datagram) for datagram in (second, first)] == [RTCP_REPORT, RTCP_REPORT]
    assert counters(unprotector) == (8 * len(first), 0)
    assert unprotector.unprotect_rtcp(first) is None
    assert counters(unprotector) == (8 * len(first), 1)


def test_two_streams_under_one_key() -> None:
    """Media and repair packets with the same number and key are encrypted differently, and both are accepted."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    streams = [packet(sequence, bytes(40), ssrc) for sequence in range(5) for ssrc in (MEDIA_SSRC, REPAIR_SSRC)]
    protected = [protector.protect(stream_packet) for stream_packet in streams]
    assert len({datagram[12:] for datagram in protected}) == 10
    assert [unprotector.unprotect(datagram) for datagram in protected] == streams


def test_packet_with_changed_ssrc_is_rejected() -> None:
    """A packet whose SSRC was changed to that of the other stream is rejected."""
    protector, unprotector = Protector(KEY), Unprotector(KEY)
    protected = protector.protect(packet(1))
    moved = protected[:8] + REPAIR_SSRC.to_bytes(4, "big") + protected[12:]
    assert unprotector.unprotect(moved) is None
    assert counters(unprotector) == (1, 0)


def test_no_second_packet_under_one_number() -> None:
    """A second packet with the same number is rejected, because two payloads under one number allow forgeries."""
    protector = Protector(KEY)
    protector.protect(packet(1, b"one"))
    with pytest.raises(WorkError, match="replay"):
        protector.protect(packet(1, b"two"))


def test_invalid_keys_and_packets() -> None:
    """A key of the wrong length and a packet that is too long or is not RTP are rejected."""
    for key in (b"", bytes(KEY_BYTES - 1), bytes(KEY_BYTES + 1)):
        with pytest.raises(UserError, match=f"28 bytes.* {len(key)}"):
            Protector(key)
        with pytest.raises(UserError, match=f"28 bytes.* {len(key)}"):
            Unprotector(key)
    with pytest.raises(UserError, match=r"1352 .*1353"):
        Protector(KEY).protect(packet(1, bytes(MAX_PACKET_BYTES - 11)))
    with pytest.raises(WorkError):
        Protector(KEY).protect(b"no packet")


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pylibsrtp the error names the extra to install."""
    monkeypatch.setitem(sys.modules, "pylibsrtp", None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[secure\]'"):
        Protector(KEY)
