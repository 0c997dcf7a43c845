"""Clock reports: which kernel's clock a host uses, and the correction that its time source reports for it."""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

from msgspec import Struct

from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.transport.clock_sync.persistent_process import NOT_FOUND, Run

TIMEOUT_S = 2.0


class ClockReport(Struct, frozen=True):
    """A report of a host's time source on the host's clock, with the clock readings at which it was made."""

    mono_ns: int
    wall_ns: int
    host: str
    """Identity of the kernel whose clock this is."""
    source: str
    """"chrony", "ptp", "external", "probe" (the host relies on the probe), or "model" in virtual time."""
    correction_s: float | None = None
    """Reference time minus the host's wall clock; None: the source does not know it."""
    bound_s: float | None = None
    """The largest error of the correction; None: unknown."""
    status: str = ""
    """Why there is no correction, or what is special about the correction; for people."""
    asking_s: float = 0.0
    """How long the query took; the clocks were read in its middle."""
    follows: str = ""
    """Address of the host, or identity of the PTP grandmaster, that the clock is synchronised to."""
    addresses: tuple[str, ...] = ()
    """The host's own addresses without loopback; they show whether the other side follows this host."""
    skew_ppm: float | None = None
    """Largest error of the source's estimate of the clock's rate."""
    age_s: float | None = None
    """Time since the source last received a sample."""
    peer_delay_s: float | None = None
    """Round trip to the source's peer, in its last sample."""
    peer_dispersion_s: float | None = None
    """Dispersion of that sample, an error in addition to that of the delay."""
    good_samples: int | None = None
    """How many samples the source has accepted so far."""
    poll_s: float | None = None
    """The source's polling interval."""


BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
IPV4_ROUTES = Path("/proc/net/fib_trie")
IPV6_ADDRESSES = Path("/proc/net/if_inet6")


def kernel_identity() -> str:
    """Return the identity of the running kernel, or "" if it has none. Processes on one kernel share its clock."""
    return _read_text(BOOT_ID).strip()


def host_addresses() -> tuple[str, ...]:
    """Return the addresses of this host without loopback, sorted; empty if the system does not list them."""
    return _addresses(_read_text(IPV4_ROUTES), _read_text(IPV6_ADDRESSES))


@lru_cache(maxsize=4)  # called every second, and the addresses hardly ever change
def _addresses(ipv4_routes: str, ipv6_addresses: str) -> tuple[str, ...]:
    """Parse the kernel's tables.

    In the IPv4 table an address is in the line before "/32 host LOCAL". In the IPv6 table it is the 32 hex digits at
    the beginning of a line.
    """
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
    return tuple(sorted({address for text in found if (address := plain_address(text))} - _LOOPBACK))


_LOOPBACK = {"127.0.0.1", "::1"}


def plain_address(text: str) -> str:
    """Return an address in canonical form, so that addresses can be compared; "" if the text is no address."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        return ""


def parse_number(text: str) -> float | None:
    """Return the number in a program's output; None if the text is not a finite number."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def unknown_clock(now: Now, host: str, source: str, status: str) -> ClockReport:
    """Return the report of a source that does not know the correction."""
    return ClockReport(now.mono_ns, now.wall_ns, host, source, status=status, addresses=host_addresses())


def query_clock(
    command: Sequence[str], clock: Clock, run: Run, *, source: str, absent: str, parse: Callable[..., ClockReport]
) -> ClockReport | None:
    """Run a program that reports on this host's clock, and parse its output.

    `parse` takes the host, the output, and readings of the clocks before and after the query. Return None if there was
    no answer in time: that is a missed poll, and no statement about the clock.
    """
    host, before = kernel_identity(), clock.now()
    completed = run(command, TIMEOUT_S)
    after = clock.now()
    if completed is None or after.mono_ns - before.mono_ns > TIMEOUT_S * NS_PER_S:  # late, or this thread was delayed
        return None
    if completed.code == NOT_FOUND:
        return unknown_clock(before, host, source, absent)
    return parse(host, completed.output, before, after)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
