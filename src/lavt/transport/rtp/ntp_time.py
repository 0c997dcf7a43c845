"""Times in RTCP: NTP timestamps, NTP short format (their middle 32 bits), and the round-trip time from these.

An NTP timestamp has 64 bits: seconds since 1900 and a 32-bit fraction (RFC 3550, section 4). The short format counts
1/65536 s and wraps every 18.2 h; differences of two are taken modulo 2^32.
"""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_S

MAX_ROUND_TRIP_NS: Final = 60 * NS_PER_S
"""A longer result means that a clock was stepped, or that the answer is for another sender."""

_UNIX_EPOCH_S: Final = 2_208_988_800
"""The year 1970 in seconds since 1900."""


def wall_to_ntp(wall_ns: int) -> int:
    """Return the NTP timestamp of a time in ns since 1970; it wraps in 2036."""
    return elapsed_to_ntp(wall_ns + _UNIX_EPOCH_S * NS_PER_S)


def elapsed_to_ntp(elapsed_ns: int) -> int:
    """Return the NTP timestamp of a clock with any epoch (RFC 3611, section 4.4, allows any)."""
    return (elapsed_ns << 32) // NS_PER_S % 2**64


def ntp_to_short(ntp_timestamp: int) -> int:
    """Return the middle 32 bits of an NTP timestamp."""
    return ntp_timestamp >> 16 & 0xFFFF_FFFF


def delay_to_short(delay_ns: int) -> int:
    """Return a delay in units of 1/65536 s, rounded and limited to 32 bits."""
    return min(max(((delay_ns << 17) + NS_PER_S) // (2 * NS_PER_S), 0), 2**32 - 1)


def short_to_delay_ns(short: int) -> int:
    """Return a delay in units of 1/65536 s as ns, rounded."""
    return (short * NS_PER_S + 2**15) >> 16


def round_trip_ns(arrived: int, last: int, delay_ns: int) -> int | None:
    """Return the round-trip time from three times (RFC 3550, section 6.4.1), in steps of 1/65536 s.

    `last` is the time that we sent and the peer returned, `delay_ns` how long the peer kept it, and `arrived` when it
    came back; `arrived` and `last` are in short format, by the same clock. Return None if the peer had not yet received
    a time that it could return (`last` is 0), or if the result is impossible: negative by more than one step, or longer
    than `MAX_ROUND_TRIP_NS`.
    """
    ticks = (arrived - last - delay_to_short(delay_ns) + 2**31) % 2**32 - 2**31
    trip_ns = short_to_delay_ns(max(ticks, 0))
    return None if last == 0 or ticks < -1 or trip_ns > MAX_ROUND_TRIP_NS else trip_ns
