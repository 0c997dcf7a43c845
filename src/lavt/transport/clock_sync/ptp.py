"""What linuxptp says of the host's clock: `pmc` asks the running `ptp4l` for its data sets (IEEE 1588-2008, 15.5.3).

It says how far the clock that ptp4l keeps is from its grandmaster's. That is the machine's wall clock only where ptp4l
steers that one itself (software time stamping); where phc2sys copies a network card's clock, name `external` instead.
"""

from __future__ import annotations

import math

from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.transport.clock_sync.clock_report import ClockReport, ask, host_addresses, unknown_clock
from lavt.transport.clock_sync.persistent_process import Run

SOURCE = "ptp"
PMC = ("pmc", "-u", "-b", "0", "GET PORT_DATA_SET", "GET CURRENT_DATA_SET", "GET TIME_STATUS_NP")
"""It takes 0.12 s: pmc waits for what may come late."""

ABSENT = "linuxptp is not installed"
NOT_RUNNING = "ptp4l is not running, or this user may not ask it"
NO_MASTER = "ptp4l is neither master nor does it hear one"


def read_ptp(clock: Clock, run: Run) -> ClockReport | None:
    """Ask ptp4l on this host; where it cannot tell, the report says so and has no correction.

    None where no answer came in time: that says nothing of the clock, and is a missed poll.
    """
    return ask(PMC, clock, run, source=SOURCE, absent=ABSENT, parse=parse_ptp)


def parse_ptp(host: str, answer: str, before: Now, after: Now) -> ClockReport:
    """Read pmc's answer to `PMC`, asked between two readings of the clocks; never raises.

    The correction is the negative of `offsetFromMaster`. The bound is `meanPathDelay` for each step to the
    grandmaster: half of each round trip, all of which an asymmetric path could hide. A master's own clock is the
    reference.
    """
    asking_ns = after.mono_ns - before.mono_ns
    middle = before.later(asking_ns // 2)
    words = [line.split() for line in answer.splitlines()]
    told = {row[0]: row[1] for row in words if len(row) == 2}
    states = [row[1] for row in words if len(row) == 2 and row[0] == "portState"]
    if "gmIdentity" not in told:
        return unknown_clock(middle, host, SOURCE, NOT_RUNNING)
    offset_ns, path_ns, steps = (
        _number(told.get(key)) for key in ("offsetFromMaster", "meanPathDelay", "stepsRemoved")
    )
    if told.get("gmPresent") == "false" and "MASTER" in states:
        offset_ns, path_ns, steps = 0.0, 0.0, 0.0
    elif told.get("gmPresent") != "true" or None in (offset_ns, path_ns, steps) or not (path_ns or 0) > 0:
        return unknown_clock(middle, host, SOURCE, NO_MASTER)
    return ClockReport(
        middle.mono_ns,
        middle.wall_ns,
        host,
        SOURCE,
        -(offset_ns or 0.0) / NS_PER_S,
        (path_ns or 0.0) * max(steps or 0.0, 0.0) / NS_PER_S,
        asking_s=asking_ns / NS_PER_S,
        follows=told["gmIdentity"],
        addresses=host_addresses(),
    )


def _number(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if math.isfinite(number) else None
