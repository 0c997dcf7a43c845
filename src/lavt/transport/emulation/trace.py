"""Traces: recorded delays or capacities of a link, read from a file and replayed by the time since the start.

There are two formats. A capacity trace in Mahimahi's format has one time per line, in whole milliseconds: an
opportunity to deliver 1500 bytes. A delay trace is CSV, `time_s,delay_ms`, with linear interpolation between the
points. Both begin again after their last time.
"""

from __future__ import annotations

import csv
import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from msgspec import Struct

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError

OPPORTUNITY_BYTES: Final = 1500
CSV_HEADER: Final = ["time_s", "delay_ms"]
LONGEST_TRACE_S: Final = 86_400
LONGEST_DELAY_MS: Final = 60_000


class CapacityTrace(Struct, frozen=True):
    """A capacity over time: opportunities to deliver 1500 bytes each, in order, which repeat after the last one."""

    times_ns: tuple[int, ...]

    def first_at(self, time_ns: int) -> int:
        """Return the number of the first opportunity at or after `time_ns`."""
        period_ns = self.times_ns[-1]
        cycle = max(0, time_ns - 1) // period_ns
        return cycle * len(self.times_ns) + bisect_left(self.times_ns, time_ns - cycle * period_ns)

    def time_ns(self, number: int) -> int:
        """Return the time of the opportunity with this number; numbers continue when the opportunities repeat."""
        cycle, index = divmod(number, len(self.times_ns))
        return cycle * self.times_ns[-1] + self.times_ns[index]


class DelayTrace(Struct, frozen=True):
    """A delay over time: points at strictly increasing times from 0, interpolated linearly and repeated."""

    times_ns: tuple[int, ...]
    delays_ns: tuple[int, ...]

    def delay_ns(self, time_ns: int) -> int:
        """Return the delay of a packet that arrives at `time_ns`."""
        elapsed_ns = max(0, time_ns) % self.times_ns[-1]
        after = bisect_right(self.times_ns, elapsed_ns)
        time_before_ns, time_after_ns = self.times_ns[after - 1 : after + 1]
        delay_before_ns, delay_after_ns = self.delays_ns[after - 1 : after + 1]
        passed_ns, interval_ns = elapsed_ns - time_before_ns, time_after_ns - time_before_ns
        return delay_before_ns + (delay_after_ns - delay_before_ns) * passed_ns // interval_ns


Trace = CapacityTrace | DelayTrace


def parse_mahimahi(text: str, source: str) -> CapacityTrace:
    """Parse a capacity in Mahimahi's format. Raise `UserError`, which names `source`, for anything else."""
    times_ms = []
    for number, line in enumerate(text.splitlines(), 1):
        entry = line.strip()
        if entry:
            times_ms.append(_parse_ms(entry, f"{source}, line {number}"))
    for number, (before, after) in enumerate(pairwise(times_ms), 2):
        if after < before:
            raise UserError(f"{source}: entry {number} is {after} ms, after one of {before} ms: sort the times")
    if not times_ms or times_ms[-1] == 0:
        raise UserError(f"{source} has no duration, so it cannot be repeated: give it an opportunity after 0 ms")
    return CapacityTrace(tuple(time_ms * NS_PER_MS for time_ms in times_ms))


def _parse_ms(entry: str, source: str) -> int:
    if not (entry.isascii() and entry.isdigit() and len(entry) <= 9 and int(entry) <= LONGEST_TRACE_S * 1000):
        raise UserError(
            f"{source}: {entry[:20]!r} is not a time of a Mahimahi trace: give whole milliseconds up to a day, one "
            "per line (a CSV file of delays needs a name that ends in .csv)"
        )
    return int(entry)


def parse_delays(text: str, source: str) -> DelayTrace:
    """Parse a delay over time from CSV. Raise `UserError`, which names `source`, for anything else."""
    try:
        rows = [row for row in csv.reader(text.splitlines()) if row]
    except csv.Error as error:
        raise UserError(f"{source} is not CSV: {error}") from error
    if not rows or [cell.strip() for cell in rows[0]] != CSV_HEADER:
        raise UserError(f"{source} must begin with the header line {','.join(CSV_HEADER)}: add it")
    points = [_parse_point(row, f"{source}, row {number}") for number, row in enumerate(rows[1:], 2)]
    times_ns, delays_ns = [time_ns for time_ns, _ in points], [delay_ns for _, delay_ns in points]
    if len(points) < 2 or times_ns[0] != 0:
        raise UserError(f"{source} needs at least two rows, the first of them at time_s 0: add them")
    for before_ns, after_ns in pairwise(times_ns):
        if after_ns <= before_ns:
            raise UserError(
                f"{source}: time_s {after_ns / NS_PER_S:g} comes after {before_ns / NS_PER_S:g}: let the times increase"
            )
    return DelayTrace(tuple(times_ns), tuple(delays_ns))


def _parse_point(row: Sequence[str], source: str) -> tuple[int, int]:
    """Return one row as time and delay in nanoseconds."""
    try:
        time_s, delay_ms = map(float, row)
    except ValueError:
        time_s = delay_ms = math.nan
    if not (0 <= time_s <= LONGEST_TRACE_S and 0 <= delay_ms <= LONGEST_DELAY_MS):
        raise UserError(
            f"{source}: {','.join(row)[:40]!r} is not a time in seconds up to a day and a delay in milliseconds up to "
            f"{LONGEST_DELAY_MS}: correct it"
        )
    return round(time_s * NS_PER_S), round(delay_ms * NS_PER_MS)
