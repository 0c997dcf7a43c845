"""What a host can say of its own clock: which kernel's clock it is, and how far its source of time finds it off."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.transport.clock_sync.persistent_process import NOT_FOUND, Run
from lavt.value import value

TIMEOUT_S = 2.0


@value
class ClockReport:
    """What a host's source of time says of its clock, beside the reading of both clocks that it belongs to."""

    mono_ns: int
    wall_ns: int
    host: str
    """Identity of the kernel whose clock this is."""
    source: str
    """Who says it: "chrony", "ptp", "external", "probe" (the host leaves it to the probe), "model" in virtual time."""
    correction_s: float | None = None
    """Reference time less the host's wall clock; None: the source does not know it."""
    bound_s: float | None = None
    """How far the correction can be from the truth; None: nobody knows."""
    status: str = ""
    """What the source says instead, in words, where there is no correction."""
    asking_s: float = 0.0
    """For how long the source was asked; the reading of the clocks is that of the middle."""
    follows: str = ""
    """Address of the host, or identity of the PTP grandmaster, that the clock is compared with."""
    addresses: tuple[str, ...] = ()
    """The host's own, without loopback: whether the other side follows this host."""
    skew_ppm: float | None = None
    """How wrong the source's estimate of the clock's rate can be."""
    age_s: float | None = None
    """Since the source last heard what it follows."""
    peer_delay_s: float | None = None
    """Round trip to what it follows, in the source's last sample."""
    peer_dispersion_s: float | None = None
    """What else that sample can be wrong by."""
    good_samples: int | None = None
    """How many samples the source has accepted so far."""
    poll_s: float | None = None
    """How often the source asks for one."""


BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
IPV4_ROUTES = Path("/proc/net/fib_trie")
IPV6_ADDRESSES = Path("/proc/net/if_inet6")


def kernel_identity() -> str:
    """Identity of the running kernel: processes that share it share a clock; empty where the system has none."""
    return _text_of(BOOT_ID).strip()


def host_addresses() -> tuple[str, ...]:
    """Addresses of this host, without loopback, in order; empty where the system does not tell."""
    return _addresses(_text_of(IPV4_ROUTES), _text_of(IPV6_ADDRESSES))


@lru_cache(maxsize=4)  # asked every second; they hardly ever change
def _addresses(ipv4_routes: str, ipv6_addresses: str) -> tuple[str, ...]:
    """Read the kernel's tables: an address is the line before "/32 host LOCAL", or 32 hex digits at a line's start."""
    lines = ipv4_routes.splitlines()
    found = {
        before.removeprefix("|--").strip()
        for before, line in zip(map(str.strip, lines), map(str.strip, lines[1:]), strict=False)
        if line == "/32 host LOCAL" and before.startswith("|--")
    }
    for line in ipv6_addresses.splitlines():
        digits = line.partition(" ")[0]
        if len(digits) == 32:
            found.add(":".join(digits[start : start + 4] for start in range(0, 32, 4)))
    return tuple(sorted({address for each in found if (address := plain_address(each))} - _LOOPBACK))


_LOOPBACK = {"127.0.0.1", "::1"}


def plain_address(text: str) -> str:
    """Write an address as all write it who must be compared; empty where it is none."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        return ""


def unknown_clock(now: Now, host: str, source: str, status: str) -> ClockReport:
    """Make the report of a source that cannot tell."""
    return ClockReport(now.mono_ns, now.wall_ns, host, source, status=status, addresses=host_addresses())


def ask(
    command: Sequence[str], clock: Clock, run: Run, *, source: str, absent: str, parse: Callable[..., ClockReport]
) -> ClockReport | None:
    """Have a program tell of this host's clock: `parse(host, its output, clocks before, clocks after)`.

    None where no answer came in time: that says nothing of the clock, and is a missed poll.
    """
    host, before = kernel_identity(), clock.now()
    ended = run(command, TIMEOUT_S)
    after = clock.now()
    if ended is None or after.mono_ns - before.mono_ns > TIMEOUT_S * NS_PER_S:  # it was in time, but this thread not
        return None
    if ended.code == NOT_FOUND:
        return unknown_clock(before, host, source, absent)
    return parse(host, ended.output, before, after)


def _text_of(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
