from __future__ import annotations

import numpy as np
import pytest

from lavt.errors import BadPacket, UserError
from lavt.transport.rtp.sdp import profile_level_id, session_description
from lavt.transport.video.h264 import Encoder

START = b"\x00\x00\x00\x01"


def test_lines_of_a_description() -> None:
    """A description has the lines of RFC 8866 in their order, each ended by CRLF."""
    description = session_description(("192.0.2.7", 5004), rate_hz=30.0, profile_level_id="42C01E")
    assert description == (
        "v=0\r\n"
        "o=- 0 0 IN IP4 127.0.0.1\r\n"
        "s=LAVT\r\n"
        "c=IN IP4 192.0.2.7\r\n"
        "t=0 0\r\n"
        "m=video 5004 RTP/AVP 96\r\n"
        "a=rtpmap:96 H264/90000\r\n"
        "a=fmtp:96 packetization-mode=1;profile-level-id=42C01E\r\n"
        "a=framerate:30\r\n"
        "a=recvonly\r\n"
        "a=rtcp-mux\r\n"
    )


def test_a_fractional_rate() -> None:
    """A fractional frame rate is written with its fraction."""
    assert "a=framerate:29.97\r\n" in session_description(("192.0.2.7", 5004), rate_hz=29.97, profile_level_id="42C01E")


def test_multicast() -> None:
    """A multicast address is followed by the time to live (RFC 8866, section 5.7)."""
    assert "c=IN IP4 239.1.2.3/1\r\n" in session_description(("239.1.2.3", 5004), rate_hz=30, profile_level_id="42C01E")


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_invalid_port_is_rejected(port: int) -> None:
    """A port outside 1 to 65535 is rejected."""
    with pytest.raises(UserError, match=f"port {port}"):
        session_description(("192.0.2.7", port), rate_hz=30, profile_level_id="42C01E")


@pytest.mark.parametrize(("size", "level"), [((640, 480), "42C01E"), ((1280, 720), "42C01F"), ((1920, 1080), "42C028")])
def test_profile_and_level_of_the_encoder(size: tuple[int, int], level: str) -> None:
    """Profile and level are read from the stream: constrained baseline, and the level that the picture size needs."""
    encoder = Encoder(*size, rate_hz=30, bit_rate_bps=4_000_000, gop_frames=30)
    assert profile_level_id(encoder.encode(np.zeros((size[1], size[0], 3), np.uint8))) == level


@pytest.mark.parametrize("access_unit", [b"", START + b"\x41\x9a\x01\x02", START + b"\x67\x42", b"\x67\x42\xc0\x1e"])
def test_access_unit_without_sequence_parameter_set(access_unit: bytes) -> None:
    """An access unit without a complete sequence parameter set (SPS) raises `BadPacket`."""
    with pytest.raises(BadPacket):
        profile_level_id(access_unit)
