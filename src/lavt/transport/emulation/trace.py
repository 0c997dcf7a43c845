"""Traces: what a link did over time, read from a file and replayed; pure functions of the time since the beginning.

Two kinds. A capacity in Mahimahi's format: one whole number of milliseconds a line, each an opportunity to deliver 1500
bytes. A delay in CSV: `time_s,delay_ms`, straight lines between the points. Both begin anew at their last time.
"""

from __future__ import annotations

import csv
import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.value import value

OPPORTUNITY_BYTES: Final = 1500
CSV_HEADER: Final = ["time_s", "delay_ms"]
LONGEST_S: Final = 86_400
LONGEST_DELAY_MS: Final = 60_000


@value
class CapacityTrace:
    """Opportunities to deliver 1500 bytes each, at these times in order, and again after the last of them."""

    times_ns: tuple[int, ...]

    def first_from(self, time_ns: int) -> int:
        """Number of the first opportunity at or after a time."""
        period_ns = self.times_ns[-1]
        lap = max(0, time_ns - 1) // period_ns
        return lap * len(self.times_ns) + bisect_left(self.times_ns, time_ns - lap * period_ns)

    def time_ns(self, number: int) -> int:
        """Time of the opportunity with a number; there is no last one."""
        lap, index = divmod(number, len(self.times_ns))
        return lap * self.times_ns[-1] + self.times_ns[index]


@value
class DelayTrace:
    """A delay over time: points at strictly increasing times from 0, joined by straight lines, again and again."""

    times_ns: tuple[int, ...]
    delays_ns: tuple[int, ...]

    def delay_ns(self, time_ns: int) -> int:
        """Delay of what comes at a time."""
        gone_ns = max(0, time_ns) % self.times_ns[-1]
        after = bisect_right(self.times_ns, gone_ns)
        begin_ns, end_ns = self.times_ns[after - 1 : after + 1]
        first_ns, last_ns = self.delays_ns[after - 1 : after + 1]
        return first_ns + (last_ns - first_ns) * (gone_ns - begin_ns) // (end_ns - begin_ns)


Trace = CapacityTrace | DelayTrace


def parse_mahimahi(text: str, where: str) -> CapacityTrace:
    """Read a capacity in Mahimahi's format; raises `UserError`, which names `where` it is from, for what is not."""
    times_ms = []
    for number, line in enumerate(text.splitlines(), 1):
        word = line.strip()
        if word:
            times_ms.append(_whole_ms(word, f"{where}, line {number}"))
    for number, (before, after) in enumerate(pairwise(times_ms), 2):
        if after < before:
            raise UserError(f"{where}: entry {number} is {after} ms, after one of {before} ms: sort the times")
    if not times_ms or times_ms[-1] == 0:
        raise UserError(f"{where} lasts no time, so it cannot be repeated: give it an opportunity after 0 ms")
    return CapacityTrace(tuple(each * NS_PER_MS for each in times_ms))


def _whole_ms(word: str, where: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 9 and int(word) <= LONGEST_S * 1000):
        raise UserError(
            f"{where}: {word[:20]!r} is no time of a Mahimahi trace: give whole milliseconds up to a day, one a line "
            "(a CSV of delays has a name that ends in .csv)"
        )
    return int(word)


def parse_delays(text: str, where: str) -> DelayTrace:
    """Read a delay over time in CSV; raises `UserError`, which names `where` it is from, for what is not."""
    try:
        rows = [row for row in csv.reader(text.splitlines()) if row]
    except csv.Error as error:
        raise UserError(f"{where} is not CSV: {error}") from error
    if not rows or [cell.strip() for cell in rows[0]] != CSV_HEADER:
        raise UserError(f"{where} must begin with the line {','.join(CSV_HEADER)}: add it")
    points = [_point(row, f"{where}, row {number}") for number, row in enumerate(rows[1:], 2)]
    if len(points) < 2 or points[0][0] != 0:
        raise UserError(f"{where} needs at least two rows, the first of them at time_s 0: add them")
    for before, after in pairwise(points):
        if after[0] <= before[0]:
            raise UserError(
                f"{where}: time_s {after[0] / NS_PER_S:g} comes after {before[0] / NS_PER_S:g}: let the times increase"
            )
    times_ns, delays_ns = zip(*points, strict=True)
    return DelayTrace(times_ns, delays_ns)


def _point(row: Sequence[str], where: str) -> tuple[int, int]:
    """Read one row as time and delay in nanoseconds."""
    try:
        time_s, delay_ms = map(float, row)
    except ValueError:
        time_s = delay_ms = math.nan
    if not (0 <= time_s <= LONGEST_S and 0 <= delay_ms <= LONGEST_DELAY_MS):
        raise UserError(
            f"{where}: {','.join(row)[:40]!r} is not a time in seconds up to a day and a delay in milliseconds up to "
            f"{LONGEST_DELAY_MS}: correct it"
        )
    return round(time_s * NS_PER_S), round(delay_ms * NS_PER_MS)
