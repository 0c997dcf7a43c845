"""What a host can say of its own clock: which kernel's clock it is, and how far chrony finds it from the reference."""

from __future__ import annotations

import math
import subprocess
from pathlib import Path

from lavt.value import value


@value
class ClockReport:
    """What the host's source of time says of the host's clock."""

    host: str
    """Identity of the kernel whose clock this is."""
    source: str
    correction_s: float
    """Reference time less the host's wall clock."""
    bound_s: float | None
    """How far the correction can be wrong; None: not known."""


BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
CHRONYC = ("chronyc", "-c", "tracking")
TRACKING_FIELDS = 14


def kernel_identity() -> str:
    """Identity of the running kernel: processes that share it share a clock; empty where the system has none."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""


def parse_tracking(host: str, line: str) -> ClockReport:
    """Read the answer of `chronyc -c tracking`: field 5 is the correction, positive where the local clock is slow.

    The bound is the root distance: half the root delay plus the root dispersion (chronyc's manual, "tracking").
    Before chrony has synchronised, and where the line is not what chrony writes, the correction is 0 and the bound
    unknown.
    """
    unknown = ClockReport(host, "chrony, not synchronised", 0.0, None)
    fields = line.strip().split(",")
    if len(fields) != TRACKING_FIELDS or fields[13] != "Normal" or fields[0] == "00000000":
        return unknown
    try:
        correction_s, delay_s, dispersion_s = (float(fields[index]) for index in (4, 10, 11))
    except ValueError:
        return unknown
    if not (math.isfinite(correction_s) and 0 <= delay_s < math.inf and 0 <= dispersion_s < math.inf):
        return unknown
    return ClockReport(host, "chrony", correction_s, delay_s / 2 + dispersion_s)


def read_clock() -> ClockReport:
    """Ask chrony on this host; without it the report says so, and has no bound."""
    host = kernel_identity()
    try:
        answer = subprocess.run(CHRONYC, capture_output=True, text=True, timeout=1, check=True)  # noqa: S603 (a constant)
        return parse_tracking(host, answer.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        return ClockReport(host, "none", 0.0, None)
