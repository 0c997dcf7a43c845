"""What a process uses, from /proc."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final, NamedTuple

UTIME_COLUMN: Final = 11
"""Of /proc/PID/stat, counted after the name of the program, which can contain spaces."""
THREADS_COLUMN: Final = 17
RSS_COLUMN: Final = 21


class Usage(NamedTuple):
    """The use of one process up to now."""

    processor_s: float
    resident_mb: float
    descriptors: int
    threads: int


def usage(pid: int) -> Usage:
    """Return what a process uses."""
    columns = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = int(columns[UTIME_COLUMN]) + int(columns[UTIME_COLUMN + 1])
    resident_mb = int(columns[RSS_COLUMN]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return Usage(ticks / os.sysconf("SC_CLK_TCK"), resident_mb, descriptors, int(columns[THREADS_COLUMN]))
