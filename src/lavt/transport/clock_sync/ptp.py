"""Clock reports from linuxptp: `pmc` queries the running `ptp4l` for its data sets (IEEE 1588-2008, 15.5.3).

The report is about the clock that ptp4l synchronises to its grandmaster. With software time stamping, this is the
machine's wall clock. If phc2sys sets the wall clock from a network card's clock, configure the source `external`
instead.
"""

from __future__ import annotations

from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.transport.clock_sync.clock_report import ClockReport, host_addresses, parse_number, query_clock, unknown_clock
from lavt.transport.clock_sync.persistent_process import Run

SOURCE = "ptp"
PMC = ("pmc", "-u", "-b", "0", "GET PORT_DATA_SET", "GET CURRENT_DATA_SET", "GET TIME_STATUS_NP")
"""The query takes 0.12 s, because pmc waits for late answers."""

ABSENT = "linuxptp is not installed"
NOT_RUNNING = "ptp4l is not running, or this user may not query it"
NO_MASTER = "ptp4l is not a master, and receives nothing from a master"


def read_ptp(clock: Clock, run: Run) -> ClockReport | None:
    """Query ptp4l on this host. If ptp4l does not know the correction, the report says why.

    Return None if there was no answer in time: that is a missed poll, and no statement about the clock.
    """
    return query_clock(PMC, clock, run, source=SOURCE, absent=ABSENT, parse=parse_ptp)


def parse_ptp(host: str, answer: str, before: Now, after: Now) -> ClockReport:
    """Parse pmc's answer to `PMC`, queried between two readings of the clocks; never raises.

    The correction is the negative of `offsetFromMaster`. The bound is `meanPathDelay` (half of a round trip) times the
    number of steps to the grandmaster, because an asymmetric path could hide an error of that size. If this host is the
    master, its own clock is the reference: correction and bound are 0.
    """
    query_ns = after.mono_ns - before.mono_ns
    middle = before.later(query_ns // 2)
    pairs = [words for line in answer.splitlines() if len(words := line.split()) == 2]
    fields = dict(pairs)
    states = [value for name, value in pairs if name == "portState"]
    if "gmIdentity" not in fields:
        return unknown_clock(middle, host, SOURCE, NOT_RUNNING)
    offset_ns, path_ns, steps = (
        parse_number(fields.get(key, "")) for key in ("offsetFromMaster", "meanPathDelay", "stepsRemoved")
    )
    if fields.get("gmPresent") == "false" and "MASTER" in states:
        offset_ns, path_ns, steps = 0.0, 0.0, 0.0
    elif fields.get("gmPresent") != "true" or None in (offset_ns, path_ns, steps) or not (path_ns or 0) > 0:
        return unknown_clock(middle, host, SOURCE, NO_MASTER)
    return ClockReport(
        middle.mono_ns,
        middle.wall_ns,
        host,
        SOURCE,
        -(offset_ns or 0.0) / NS_PER_S,
        (path_ns or 0.0) * max(steps or 0.0, 0.0) / NS_PER_S,
        asking_s=query_ns / NS_PER_S,
        follows=fields["gmIdentity"],
        addresses=host_addresses(),
    )
