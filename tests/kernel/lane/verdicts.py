"""Which stalls of the host explain that a drive went wrong.

A drive that went wrong is a fault, unless the record has a stall that is long enough at the time that counts. A machine
that uses up its processor for a second loses 50 to 60 ms of it to ordinary programs, if there are any (the kernel's
fair server). That is a stall, too: a fault that occupies the processor all the time could hide behind it only if all
three attempts failed within 200 ms of one. Longer stalls, and shares above 6 %, are never a machine's own doing.
"""

from __future__ import annotations

import math
import re

from tests.field.by_wire import KIT_MS, STOP_BEFORE_MS, STOP_STALL_MS
from tests.kernel.lane.driving import Drive, reasons_against
from tests.support.stalls import HostStalled, Stalls, described, stalled_share

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.metrics import driving_interval

ROOM_MS = 60
"""One period of commands to the kit, or of its reports, and two for a slow machine: a shorter stall explains less."""
KIT_STALL_MS = KIT_MS - ROOM_MS
UNSAMPLED_STALL_MS = 1500
"""Clocks are sampled once a second, and may be unsampled for 2.5 s."""
STALL_MS = {"the clock of the ": UNSAMPLED_STALL_MS, "the clock samples of the ": UNSAMPLED_STALL_MS}
"""The least stall that explains a reason against a drive, by how the reason begins.

None explains the others. Records that are not complete or lost messages, and clocks that were set, are no matter of
times. The sources of time and the sum of the loop's parts are judged by shortest round trips or by 95 of 100 samples.
"""
MEDIAN_SHARE = 0.07
"""Share of a time that must be stalled to explain medians over it: more than a machine can lose by using up its
processor."""
SLOW_SHARE = 0.15
"""Share of a drive by wire that must be stalled to explain that the machine was too slow for it. With 15 ms of each
100 ms taken away it drives as well as without (`docs/by_wire.md`)."""
REPORTS = re.compile(r"Report\w* for (\d+) ms")


def require_valid(driven: Drive, stalls: Stalls, about: str | None = None) -> None:
    """Require that nothing speaks against a drive, except for the reason that the test is about."""
    reasons = [each for each in reasons_against(driven) if about is None or not each.startswith(about)]
    if reasons:
        began_ns, ended_ns, _ = driving_interval(driven.server)
        least_ms = max(map(least_stall_ms, reasons))
        raise stalls.verdict("; ".join(reasons), min(began_ns, ended_ns), ended_ns, stall_ms=least_ms)


def least_stall_ms(reason: str) -> float:
    """Return the length of the shortest stall that explains a reason against a drive; infinite where none does."""
    return next((least_ms for begin, least_ms in STALL_MS.items() if reason.startswith(begin)), math.inf)


def require_completed(driven: Drive, stalls: Stalls) -> None:
    """Require that the route was driven to its end; only a safe stop before can be explained by a stall."""
    if driven.result["ending"] != "completed":
        raise stopped_wrongly(driven, stalls, "safe_stop", f"{driven.result['ending']}: {changes_of_safety(driven)}")


def require_never_degraded(driven: Drive, stalls: Stalls) -> None:
    """Require that commands came in time during the whole drive."""
    if any("-> degraded" in each for each in changes_of_safety(driven)):
        raise stopped_wrongly(driven, stalls, "degraded", str(changes_of_safety(driven)))


def stopped_wrongly(driven: Drive, stalls: Stalls, state: str, said: str) -> Exception:
    """Return what to raise for a safety state that was entered because something came too late."""
    changes = [(at_ns, detail) for at_ns, detail in _safety(driven) if f"-> {state}" in detail]
    if not changes:
        return AssertionError(said)
    at_ns, reason = changes[0]
    return stalls.verdict(said, at_ns - STOP_BEFORE_MS * NS_PER_MS, at_ns, stall_ms=least_stop_ms(reason))


def least_stop_ms(reason: str) -> float:
    """Return the length of the shortest stall that explains a safety state, by the reason that the server gives.

    Without a command it is degraded after 300 ms and stops after 500 ms; pictures come each 67 ms. Reports of the kit
    may be missing for as long as the reason says.
    """
    limits_ms = [int(limit_ms) for limit_ms in REPORTS.findall(reason)]
    return min(limits_ms) - ROOM_MS if limits_ms else STOP_STALL_MS


def or_too_slow(failure: Exception, stalls: Stalls, since_ns: int, until_ns: int) -> Exception:
    """Return `HostStalled` also where many short stalls made the machine too slow, else the failure."""
    if isinstance(failure, HostStalled):
        return failure
    recorded = stalls.during(since_ns, until_ns)
    share = stalled_share(recorded, since_ns, until_ns)
    said = f"stalled for {share:.1%} of the time, {described(recorded, since_ns)}; {failure}"
    return AssertionError(said) if share < SLOW_SHARE else HostStalled(said)


def changes_of_safety(driven: Drive) -> list[str]:
    """Return the changes of the safety state, in order."""
    return [detail for _, detail in _safety(driven)]


def _safety(driven: Drive) -> list[tuple[int, str]]:
    events = driven.server.table("event")
    told = zip(events.texts("kind"), events.ints("mono_ns").tolist(), events.texts("detail"), strict=True)
    return [(at_ns, detail) for kind, at_ns, detail in told if kind == "safety"]
