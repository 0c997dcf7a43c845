"""Times as RTCP carries them: NTP timestamps, their middle 32 bits, and the round trip these give.

An NTP timestamp is 64 bits: seconds since 1900 and a 32 bit fraction (RFC 3550, section 4). Its middle 32 bits count
1/65536 s and wrap every 18.2 h; differences of two are taken modulo 2^32.
"""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_S

MAX_ROUND_TRIP_NS: Final = 60 * NS_PER_S
"""What seems longer is a clock that was set, or a report that is not about ours."""

_UNIX_EPOCH_S: Final = 2_208_988_800
"""1970 in seconds since 1900."""


def ntp_of_wall(wall_ns: int) -> int:
    """Give the NTP timestamp of a time in ns since 1970; it wraps in 2036."""
    return ntp_of_elapsed(wall_ns + _UNIX_EPOCH_S * NS_PER_S)


def ntp_of_elapsed(elapsed_ns: int) -> int:
    """Give the NTP timestamp of a clock that counts ns from anywhere (RFC 3611, section 4.4, allows any)."""
    return (elapsed_ns << 32) // NS_PER_S % 2**64


def short_time(ntp_timestamp: int) -> int:
    """Take the middle 32 bits of an NTP timestamp."""
    return ntp_timestamp >> 16 & 0xFFFF_FFFF


def short_delay(delay_ns: int) -> int:
    """Give a delay in units of 1/65536 s, the nearest that fits 32 bits."""
    return min(max(((delay_ns << 17) + NS_PER_S) // (2 * NS_PER_S), 0), 2**32 - 1)


def delay_ns_of(short: int) -> int:
    """Give the ns, to the nearest, of a delay in units of 1/65536 s."""
    return (short * NS_PER_S + 2**15) >> 16


def round_trip_ns(arrived: int, last: int, delay_ns: int) -> int | None:
    """Give the round trip from three times (RFC 3550, section 6.4.1), in steps of 1/65536 s.

    `last` is what we sent and got back, `delay_ns` how long the peer kept it, and `arrived` when it was back; `arrived`
    and `last` are middle 32 bits by the same clock. None: the peer had nothing to send back (`last` is 0), or the round
    trip is impossible: shorter than none by more than one step, or longer than `MAX_ROUND_TRIP_NS`.
    """
    ticks = (arrived - last - short_delay(delay_ns) + 2**31) % 2**32 - 2**31
    trip_ns = delay_ns_of(max(ticks, 0))
    return None if last == 0 or ticks < -1 or trip_ns > MAX_ROUND_TRIP_NS else trip_ns
