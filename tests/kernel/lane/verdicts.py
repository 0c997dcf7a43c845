"""Verdicts on failed drives: which stalls of the host explain a failure.

A failed drive is a fault, unless a long enough stall was recorded at the relevant time.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection

from tests.field.by_wire import KIT_TIMEOUT_MS, STOP_LOOKBACK_MS, STOP_STALL_MS
from tests.kernel.lane.driving import DriveResult, invalid_reasons
from tests.support.stalls import Stalls

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.invalid_reason import InvalidCode
from lavt.experiment.analysis.metrics import driving_interval

MARGIN_MS = 60
"""A stall can be this much shorter than the timeout that it causes: one period of the kit's commands or reports, and
two more periods on a slow machine."""
KIT_STALL_MS = KIT_TIMEOUT_MS - MARGIN_MS
UNSAMPLED_STALL_MS = 1500
"""Clocks are sampled once a second, and a gap of up to 2.5 s is valid."""
STALL_MS_BY_CODE = {InvalidCode.CLOCK_NOT_SAMPLED: UNSAMPLED_STALL_MS}
"""The shortest stall that explains why a drive is invalid, by the code of the reason.

No stall explains other reasons, except those of `MEDIAN_CODES`. Incomplete records, lost messages and stepped clocks
do not depend on timing. The time sources and the sum of the loop's parts are judged by the shortest round trips or by
95 of 100 samples, which a stall does not change.
"""
MEDIAN_SHARE = 0.07
"""Share of a drive that must be stalled to explain medians that are too large."""
MEDIAN_CODES = {InvalidCode.INJECTION_DIFFERS, InvalidCode.INJECTION_NOT_IN_FORCE}
"""Reasons about medians of measured delays, which `MEDIAN_SHARE` explains."""
REPORT_TIMEOUT = re.compile(r"Report\w* for (\d+) ms")


def require_valid(drive: DriveResult, stalls: Stalls, expected_codes: Collection[InvalidCode] = ()) -> None:
    """Require that a drive is valid, except for the reasons that the test expects."""
    reasons = [reason for reason in invalid_reasons(drive) if reason.code not in expected_codes]
    if not reasons:
        return
    began_ns, ended_ns, _ = driving_interval(drive.server)
    since_ns = min(began_ns, ended_ns)
    message = "; ".join(reason.text for reason in reasons)
    other_codes = {reason.code for reason in reasons} - MEDIAN_CODES
    if other_codes:
        required_stall_ms = max(STALL_MS_BY_CODE.get(code, math.inf) for code in other_codes)
        raise stalls.verdict(message, since_ns, ended_ns, stall_ms=required_stall_ms)
    raise stalls.share_verdict(message, since_ns, ended_ns, share=MEDIAN_SHARE)


def require_completed(drive: DriveResult, stalls: Stalls) -> None:
    """Require that the route was driven to its end; a stall can explain only a safe stop before that."""
    if drive.result["ending"] != "completed":
        raise explain_state(drive, stalls, "safe_stop", f"{drive.result['ending']}: {safety_changes(drive)}")


def require_never_degraded(drive: DriveResult, stalls: Stalls) -> None:
    """Require that commands arrived in time during the whole drive."""
    if any("-> degraded" in change for change in safety_changes(drive)):
        raise explain_state(drive, stalls, "degraded", str(safety_changes(drive)))


def explain_state(drive: DriveResult, stalls: Stalls, state: str, message: str) -> Exception:
    """Return the exception for a safety state that was entered because of a timeout."""
    changes = [(at_ns, detail) for at_ns, detail in _safety(drive) if f"-> {state}" in detail]
    if not changes:
        return AssertionError(message)
    at_ns, reason = changes[0]
    return stalls.verdict(message, at_ns - STOP_LOOKBACK_MS * NS_PER_MS, at_ns, stall_ms=shortest_stall_ms(reason))


def shortest_stall_ms(reason: str) -> float:
    """Return the length of the shortest stall that explains a safety state, by the server's reason.

    Without commands the state is degraded after 300 ms, and a safe stop follows after 500 ms; frames come every 67 to
    100 ms. The kit's reports may be missing for as long as the reason says.
    """
    limits_ms = [int(limit_ms) for limit_ms in REPORT_TIMEOUT.findall(reason)]
    return min(limits_ms) - MARGIN_MS if limits_ms else STOP_STALL_MS


def entered_ns(drive: DriveResult, state: str) -> int | None:
    """Return when a safety state was entered first, or None if it never was."""
    return next((at_ns for at_ns, detail in _safety(drive) if f"-> {state}" in detail), None)


def safety_changes(drive: DriveResult) -> list[str]:
    """Return the changes of the safety state in order."""
    return [detail for _, detail in _safety(drive)]


def _safety(drive: DriveResult) -> list[tuple[int, str]]:
    events = drive.server.table("event")
    rows = zip(events.texts("kind"), events.ints("mono_ns").tolist(), events.texts("detail"), strict=True)
    return [(at_ns, detail) for kind, at_ns, detail in rows if kind == "safety"]
