"""What chrony says of the host's clock: `chronyc -c` (comma-separated values, in the order of chronyc's manual).

One chronyc stays and is asked again and again: it answers within 0.3 ms, and nothing has to be started for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.transport.clock_sync.clock_report import ClockReport, ask, host_addresses, plain_address, unknown_clock
from lavt.transport.clock_sync.persistent_process import Completed, PersistentProcess, Run

SOURCE = "chrony"
REPORTS = ("tracking", "ntpdata")
"""Who may not see the second (it needs root) still gets the first."""
TRACKING_FIELDS = 14
NTPDATA_FIELDS = 34
SYNCHRONISED = {"Normal", "Insert second", "Delete second"}
LOCAL_REFERENCE = "7F7F0101"
"""Reference of a chronyd that follows nobody and says that its own clock is the reference ("local")."""

ABSENT = "chrony is not installed"
NOT_RUNNING = "chrony is not running"
NOT_SYNCHRONISED = "chrony is not synchronised"


class Chronyc(PersistentProcess):
    """chrony's own client, obeying one command a line."""

    program = ("chronyc", "-n", "-c")
    NO_COMMAND: Final = "lavt"
    END: Final = "Unrecognized command\n"
    """What chronyc itself answers to that, after all else that it was told to do."""

    def lines(self, command: Sequence[str]) -> str:
        """Write each word as a command of its own, and behind them one that chronyc does not know."""
        return "".join(f"{each}\n" for each in (*command, self.NO_COMMAND))

    def ended(self, answer: bytes) -> Completed | None:
        """Read what it said until then."""
        said = answer.decode(errors="replace")
        return Completed(0, said.removesuffix(self.END)) if said.endswith(self.END) else None


def read_chrony(clock: Clock, run: Run) -> ClockReport | None:
    """Ask chrony on this host through `Chronyc`; where it cannot tell, the report says so and has no correction.

    None where no answer came in time: that says nothing of the clock, and is a missed poll.
    """
    return ask(REPORTS, clock, run, source=SOURCE, absent=ABSENT, parse=parse_chrony)


def parse_chrony(host: str, answer: str, before: Now, after: Now) -> ClockReport:
    """Read chronyc's answer to `REPORTS`, asked between two readings of the clocks; never raises.

    Field 5 of "tracking" is the correction, positive where the local clock is slow; the bound is the root distance:
    half the root delay plus the root dispersion. Of "ntpdata" the source that is followed counts. Before chrony has
    synchronised, and where the lines are not what chrony writes, the correction is not known.
    """
    asking_ns = after.mono_ns - before.mono_ns
    middle = before.later(asking_ns // 2)
    rows = [line.strip().split(",") for line in answer.splitlines()]
    tracking = next((row for row in rows if len(row) == TRACKING_FIELDS), None)
    if tracking is None:
        return unknown_clock(middle, host, SOURCE, NOT_RUNNING)
    reference_s, correction_s, skew_ppm, delay_s, dispersion_s = (_number(tracking[at]) for at in (3, 4, 9, 10, 11))
    if (
        tracking[13] not in SYNCHRONISED
        or tracking[0] == "00000000"
        or correction_s is None
        or not _not_negative(delay_s, dispersion_s)
    ):
        return unknown_clock(middle, host, SOURCE, NOT_SYNCHRONISED)
    age_s = None if reference_s is None else max(0.0, middle.wall_ns / NS_PER_S + correction_s - reference_s)
    follows = plain_address(tracking[1])
    peer = next((row for row in rows if len(row) == NTPDATA_FIELDS and plain_address(row[0]) == follows != ""), None)
    peer_delay_s, peer_dispersion_s = _numbers_of(peer, (19, 20))
    poll_log2 = None if peer is None else _number(peer[9])
    return ClockReport(
        middle.mono_ns,
        middle.wall_ns,
        host,
        SOURCE,
        correction_s,
        (delay_s or 0.0) / 2 + (dispersion_s or 0.0),
        asking_s=asking_ns / NS_PER_S,
        follows=follows,
        addresses=host_addresses(),
        skew_ppm=skew_ppm if _not_negative(skew_ppm) else None,
        age_s=age_s,
        peer_delay_s=peer_delay_s,
        peer_dispersion_s=peer_dispersion_s,
        good_samples=int(peer[33]) if peer and peer[33].isascii() and peer[33].isdigit() else None,
        # Not the field after it: that one is a whole number, and 0 where chrony polls twice a second.
        poll_s=2.0**poll_log2 if poll_log2 is not None and -7 <= poll_log2 <= 24 else None,
        status="its own clock is the reference" if tracking[0] == LOCAL_REFERENCE else "",
    )


def _numbers_of(row: Sequence[str] | None, places: Sequence[int]) -> list[float | None]:
    """Read quantities that cannot be negative; None where there is no row, or where one is not what it should be."""
    found = [None if row is None else _number(row[at]) for at in places]
    return [each if _not_negative(each) else None for each in found]


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _not_negative(*numbers: float | None) -> bool:
    return all(number is not None and number >= 0 for number in numbers)
