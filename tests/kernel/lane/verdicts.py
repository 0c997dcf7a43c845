"""Verdicts on failed drives: which stalls of the host explain a failure.

A failed drive is a fault, unless the record has a long enough stall at the relevant time. A machine that uses its
processor fully for a second loses 50 to 60 ms of it to ordinary programs, if there are any (the kernel's fair server).
That is a stall, too: a fault that occupies the processor all the time could hide behind it only if all three attempts
failed within 200 ms of one. A machine by itself never causes longer stalls, or shares above 6 %.
"""

from __future__ import annotations

import math
import re

from tests.field.by_wire import KIT_MS, STOP_BEFORE_MS, STOP_STALL_MS
from tests.kernel.lane.driving import DriveResult, reasons_against
from tests.support.stalls import Stalls

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.metrics import driving_interval

MARGIN_MS = 60
"""One period of the commands to the kit or of its reports, and two for a slow machine, which a stall may lack."""
KIT_STALL_MS = KIT_MS - 30
"""Commands are 20 ms apart. Longer than the stalls of a machine that uses its processor fully: those excuse no kit."""
UNSAMPLED_STALL_MS = 1500
"""Clocks are sampled once a second, and a gap of up to 2.5 s is valid."""
STALL_MS = {"the clock of the ": UNSAMPLED_STALL_MS, "the clock samples of the ": UNSAMPLED_STALL_MS}
"""The shortest stall that explains a reason against a drive, by the beginning of the reason.

No stall explains other reasons: incomplete records, lost messages and stepped clocks do not depend on timing, and the
time sources and the sum of the loop's parts are judged by shortest round trips or by 95 of 100 samples.
"""
MEDIAN_SHARE = 0.07
"""Share of a time that must be stalled to explain too large medians: more than a machine loses by using its
processor fully."""
REPORTS = re.compile(r"Report\w* for (\d+) ms")


def require_valid(drive: DriveResult, stalls: Stalls, expected_reason: str | None = None) -> None:
    """Require that a drive is valid, except for the reason that the test expects."""
    reasons = [
        each for each in reasons_against(drive) if expected_reason is None or not each.startswith(expected_reason)
    ]
    if reasons:
        began_ns, ended_ns, _ = driving_interval(drive.server)
        least_ms = max(map(least_stall_ms, reasons))
        raise stalls.verdict("; ".join(reasons), min(began_ns, ended_ns), ended_ns, stall_ms=least_ms)


def least_stall_ms(reason: str) -> float:
    """Return the length of the shortest stall that explains a reason against a drive; infinite if none does."""
    return next((least_ms for begin, least_ms in STALL_MS.items() if reason.startswith(begin)), math.inf)


def require_completed(drive: DriveResult, stalls: Stalls) -> None:
    """Require that the route was driven to its end; a stall can only explain a safe stop before."""
    if drive.result["ending"] != "completed":
        raise explain_state(drive, stalls, "safe_stop", f"{drive.result['ending']}: {changes_of_safety(drive)}")


def require_never_degraded(drive: DriveResult, stalls: Stalls) -> None:
    """Require that commands arrived in time during the whole drive."""
    if any("-> degraded" in each for each in changes_of_safety(drive)):
        raise explain_state(drive, stalls, "degraded", str(changes_of_safety(drive)))


def explain_state(drive: DriveResult, stalls: Stalls, state: str, message: str) -> Exception:
    """Return the exception for a safety state that was entered because of a timeout."""
    changes = [(at_ns, detail) for at_ns, detail in _safety(drive) if f"-> {state}" in detail]
    if not changes:
        return AssertionError(message)
    at_ns, reason = changes[0]
    return stalls.verdict(message, at_ns - STOP_BEFORE_MS * NS_PER_MS, at_ns, stall_ms=least_stop_ms(reason))


def least_stop_ms(reason: str) -> float:
    """Return the length of the shortest stall that explains a safety state, by the server's reason.

    Without commands the state is degraded after 300 ms, and a safe stop follows after 500 ms; frames come every 67 ms.
    The kit's reports may be missing for as long as the reason says.
    """
    limits_ms = [int(limit_ms) for limit_ms in REPORTS.findall(reason)]
    return min(limits_ms) - MARGIN_MS if limits_ms else STOP_STALL_MS


def changes_of_safety(drive: DriveResult) -> list[str]:
    """Return the changes of the safety state in order."""
    return [detail for _, detail in _safety(drive)]


def _safety(drive: DriveResult) -> list[tuple[int, str]]:
    events = drive.server.table("event")
    rows = zip(events.texts("kind"), events.ints("mono_ns").tolist(), events.texts("detail"), strict=True)
    return [(at_ns, detail) for kind, at_ns, detail in rows if kind == "safety"]
