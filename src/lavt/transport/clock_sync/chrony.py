"""Clock reports from chrony: parses the output of `chronyc -c` (comma-separated values, as in chronyc's manual).

One persistent chronyc answers each query within 0.3 ms, without starting a process.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.transport.clock_sync.clock_report import (
    ClockReport,
    host_addresses,
    parse_number,
    plain_address,
    query_clock,
    unknown_clock,
)
from lavt.transport.clock_sync.persistent_process import Completed, PersistentProcess, Run

SOURCE = "chrony"
REPORTS = ("tracking", "ntpdata")
"""The reports that chronyc is asked for; without root only the first is available."""
TRACKING_FIELDS = 14
NTPDATA_FIELDS = 34
SYNCHRONISED = {"Normal", "Insert second", "Delete second"}
LOCAL_REFERENCE = "7F7F0101"
"""The reference that chronyd reports while it has no source and uses its own clock (directive `local`)."""

ABSENT = "chrony is not installed"
NOT_RUNNING = "chrony is not running"
NOT_SYNCHRONISED = "chrony is not synchronised"


class Chronyc(PersistentProcess):
    """A persistent chronyc, chrony's own client, that executes one command per line."""

    program = ("chronyc", "-n", "-c")
    UNKNOWN_COMMAND: Final = "lavt"
    END: Final = "Unrecognized command\n"
    """chronyc's answer to the unknown command, which follows its answers to all others."""

    def encode(self, command: Sequence[str]) -> str:
        """Return the input for chronyc: each word as a separate command, then a command that chronyc does not know."""
        return "".join(f"{word}\n" for word in (*command, self.UNKNOWN_COMMAND))

    def parse_answer(self, answer: bytes) -> Completed | None:
        """Return the output before chronyc's answer to the unknown command, or None before that answer has arrived."""
        output = answer.decode(errors="replace")
        return Completed(0, output.removesuffix(self.END)) if output.endswith(self.END) else None


def read_chrony(clock: Clock, run: Run) -> ClockReport | None:
    """Query chrony on this host through `Chronyc`. If chrony does not know the correction, the report says why.

    Return None if there was no answer in time: that is a missed poll, and no statement about the clock.
    """
    return query_clock(REPORTS, clock, run, source=SOURCE, absent=ABSENT, parse=parse_chrony)


def parse_chrony(host: str, answer: str, before: Now, after: Now) -> ClockReport:
    """Parse chronyc's answer to `REPORTS`, queried between two readings of the clocks; never raises.

    Field 5 of "tracking" (counted from 1) is the correction, positive if the local clock is slow. The bound is the root
    distance: half the root delay plus the root dispersion. The "ntpdata" line of the selected source is used. The
    correction is unknown before chrony has synchronised, and if the lines are not chrony's.
    """
    query_ns = after.mono_ns - before.mono_ns
    middle = before.later(query_ns // 2)
    rows = [line.strip().split(",") for line in answer.splitlines()]
    tracking = next((row for row in rows if len(row) == TRACKING_FIELDS), None)
    if tracking is None:
        return unknown_clock(middle, host, SOURCE, NOT_RUNNING)
    reference_s, correction_s, skew_ppm, delay_s, dispersion_s = (
        parse_number(tracking[column]) for column in (3, 4, 9, 10, 11)
    )
    reference_id, leap_status = tracking[0], tracking[13]
    if (
        leap_status not in SYNCHRONISED
        or reference_id == "00000000"
        or correction_s is None
        or not _not_negative(delay_s, dispersion_s)
    ):
        return unknown_clock(middle, host, SOURCE, NOT_SYNCHRONISED)
    age_s = None if reference_s is None else max(0.0, middle.wall_ns / NS_PER_S + correction_s - reference_s)
    follows = plain_address(tracking[1])
    peer = next((row for row in rows if len(row) == NTPDATA_FIELDS and plain_address(row[0]) == follows != ""), None)
    peer_delay_s, peer_dispersion_s = _parse_numbers(peer, (19, 20))
    # The field after the logarithm of the polling interval has whole seconds, which are 0 for two polls a second.
    poll_log2 = None if peer is None else parse_number(peer[9])
    good_samples = "" if peer is None else peer[33]
    return ClockReport(
        middle.mono_ns,
        middle.wall_ns,
        host,
        SOURCE,
        correction_s,
        (delay_s or 0.0) / 2 + (dispersion_s or 0.0),
        asking_s=query_ns / NS_PER_S,
        follows=follows,
        addresses=host_addresses(),
        skew_ppm=skew_ppm if _not_negative(skew_ppm) else None,
        age_s=age_s,
        peer_delay_s=peer_delay_s,
        peer_dispersion_s=peer_dispersion_s,
        good_samples=int(good_samples) if good_samples.isascii() and good_samples.isdigit() else None,
        poll_s=2.0**poll_log2 if poll_log2 is not None and -7 <= poll_log2 <= 24 else None,
        status="its own clock is the reference" if reference_id == LOCAL_REFERENCE else "",
    )


def _parse_numbers(row: Sequence[str] | None, columns: Sequence[int]) -> list[float | None]:
    """Return the numbers in these columns, which cannot be negative; None for an invalid value or a missing row."""
    numbers = [None if row is None else parse_number(row[column]) for column in columns]
    return [number if _not_negative(number) else None for number in numbers]


def _not_negative(*numbers: float | None) -> bool:
    return all(number is not None and number >= 0 for number in numbers)
