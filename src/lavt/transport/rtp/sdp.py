"""Session description (SDP, RFC 8866) of LAVT's RTP stream: the file with which a plain RTP receiver opens it."""

from __future__ import annotations

from ipaddress import IPv4Address
from typing import Final

from lavt.errors import BadPacket, UserError
from lavt.transport.rtp.rtp import VIDEO_PAYLOAD_TYPE, split_nal_units

_SEQUENCE_PARAMETERS: Final = 7
"""NAL unit type of a sequence parameter set (H.264, table 7-1)."""
_NAL_TYPE: Final = 0x1F
_MULTICAST_HOPS: Final = "/1"
"""The time to live of multicast datagrams: the kernel's default."""


def session_description(receiver: tuple[str, int], *, rate_hz: float, profile_level_id: str) -> str:
    """Return the SDP file of the stream to `receiver`, an IPv4 address and a port.

    `profile_level_id` is that of the stream's parameter sets, in hexadecimal. RTCP uses the port of RTP. Raises
    `UserError` for a port that no receiver can open. Sources: RFC 8866; RFC 6184, section 8.2.1, for the format;
    RFC 5761 for RTCP.
    """
    address, port = IPv4Address(receiver[0]), receiver[1]
    if not 1 <= port <= 65535:
        raise UserError(f"a receiver cannot listen on port {port} of {address}: choose a port of 1 to 65535")
    lines = (
        "v=0",
        "o=- 0 0 IN IP4 127.0.0.1",  # does not reveal the server's user and address
        "s=LAVT",
        f"c=IN IP4 {address}{_MULTICAST_HOPS if address.is_multicast else ''}",
        "t=0 0",
        f"m=video {port} RTP/AVP {VIDEO_PAYLOAD_TYPE}",
        f"a=rtpmap:{VIDEO_PAYLOAD_TYPE} H264/90000",
        f"a=fmtp:{VIDEO_PAYLOAD_TYPE} packetization-mode=1;profile-level-id={profile_level_id}",
        f"a=framerate:{rate_hz:g}",
        "a=recvonly",
        "a=rtcp-mux",
    )
    return "".join(f"{line}\r\n" for line in lines)


def profile_level_id(access_unit: bytes) -> str:
    """Return profile, constraints and level from the sequence parameters of a keyframe (annex B): six digits.

    Raises `BadPacket` for an access unit without sequence parameters.
    """
    for unit in split_nal_units(access_unit):
        if unit[0] & _NAL_TYPE == _SEQUENCE_PARAMETERS and len(unit) >= 4:
            return unit[1:4].hex().upper()
    raise BadPacket("an access unit without sequence parameters")
